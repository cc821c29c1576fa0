"""Categories of nuScenes and TruckScenes as those of Argoverse 2."""

from __future__ import annotations

OWN_TRAILER = "vehicle.ego_trailer"  # the trailer of the recording truck of TruckScenes

NUSCENES_CATEGORIES: dict[str, str] = {
    "animal": "ANIMAL",
    "human.pedestrian.adult": "PEDESTRIAN",
    "human.pedestrian.child": "PEDESTRIAN",
    "human.pedestrian.construction_worker": "PEDESTRIAN",
    "human.pedestrian.personal_mobility": "PEDESTRIAN",
    "human.pedestrian.police_officer": "PEDESTRIAN",
    "human.pedestrian.stroller": "STROLLER",
    "human.pedestrian.wheelchair": "WHEELCHAIR",
    "movable_object.barrier": "NONE",
    "movable_object.debris": "NONE",
    "movable_object.pushable_pullable": "NONE",
    "movable_object.trafficcone": "CONSTRUCTION_CONE",
    "static_object.bicycle_rack": "NONE",
    "vehicle.bicycle": "BICYCLE",
    "vehicle.bus.bendy": "ARTICULATED_BUS",
    "vehicle.bus.rigid": "BUS",
    "vehicle.car": "REGULAR_VEHICLE",
    "vehicle.construction": "LARGE_VEHICLE",
    "vehicle.emergency.ambulance": "LARGE_VEHICLE",
    "vehicle.emergency.police": "REGULAR_VEHICLE",
    "vehicle.motorcycle": "MOTORCYCLE",
    "vehicle.trailer": "VEHICULAR_TRAILER",
    "vehicle.truck": "TRUCK",
}
"""Category of a box -> name in Argoverse 2; NONE = background, although its points move with the box."""

TRUCKSCENES_CATEGORIES: dict[str, str] = {
    **NUSCENES_CATEGORIES,
    "animal": "NONE",
    "static_object.traffic_sign": "SIGN",
    "vehicle.other": "NONE",
    "vehicle.train": "NONE",
    OWN_TRAILER: "NONE",
}
"""Category of a box -> name in Argoverse 2, as for nuScenes."""
