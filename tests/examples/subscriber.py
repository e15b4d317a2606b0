"""Print a running bench's activity, without importing it: zenoh, pyarrow and the bench's own schema suffice.

.venv/bin/golfbench run                                                 # terminal 1
.venv/bin/python tests/examples/subscriber.py bench1 tcp/127.0.0.1:7451 # terminal 2
"""

import json
import sys

import pyarrow as pa
import zenoh

bench, endpoint = sys.argv[1:3]
settings = {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}
settings["transport/shared_memory/enabled"] = False  # its files would outlive a kill
config = zenoh.Config()
for name, value in settings.items():
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config) as session:
    (answer,) = session.get(f"golfbench/{bench}/schema")
    assert answer.ok, "no answer: denied or not running"
    contract = json.loads(answer.ok.payload.to_bytes())
    units = {column["name"]: column["unit"] for column in contract["telemetry"]["columns"]}
    phases = contract["enumerations"]["phase"]
    print(f"{contract['bench']}: {len(units)} columns, wrist in {units['angle_wrist']}", flush=True)
    received = 0
    subscriber = session.declare_subscriber(f"golfbench/{bench}/telemetry")
    for sample in subscriber:
        batch, facts = pa.ipc.open_stream(sample.payload.to_bytes()).read_next_batch_with_custom_metadata()
        missed, received = int(facts[b"sequence"]) - received - 1 if received else 0, int(facts[b"sequence"])
        last = batch.slice(batch.num_rows - 1).to_pylist()[0]
        wrist, phase = last["angle_wrist"], phases[str(last["phase"])]
        print(f"{received} {last['time']:.3f} s {phase} wrist {wrist:.3f}, {missed} missed", flush=True)
