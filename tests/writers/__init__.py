"""Write simulated drives in the layouts of data sets, so that their readers can be tested and scored.

A log appears under its name only when it is complete. If a writer fails, an existing log of that name stays.
"""

from __future__ import annotations

from cflow_torch.simulator.benchmark import AV2, Format
from writers.aevascenes import write_aevascenes_sequence
from writers.nuscenes import write_nuscenes
from writers.truckscenes import write_truckscenes
from writers.waymo import write_waymo_segment

# Sets without a ground mask get one. nuScenes is read at 10 Hz, as in the challenge.
_NO_MASK = {"find_ground": "grid"}
FORMATS = {
    "av2": AV2,
    "nuscenes": Format("nuscenes", write_nuscenes, {**_NO_MASK, "sweep_step": 2}),
    "truckscenes": Format("truckscenes", write_truckscenes, _NO_MASK),
    "waymo": Format("waymo", write_waymo_segment, _NO_MASK),
    "aevascenes": Format("aevascenes", write_aevascenes_sequence),
}
