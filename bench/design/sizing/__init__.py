"""From a demand (head speed, attack angle, club) to hardware: catalogue, candidates, swings, front."""
