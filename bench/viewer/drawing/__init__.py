"""The robot as drawn bodies: from one configuration to meshes, URDF, glTF and STEP."""
