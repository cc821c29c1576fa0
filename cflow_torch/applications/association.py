"""Associate tracks with the moving groups and the static points of the next sweep, by shared voxels and by boxes."""

from __future__ import annotations

from typing import Iterator, NamedTuple

import torch
from torch import Tensor

from cflow_torch.applications.moving_groups import MIN_POINTS, MovingGroups, pose_of
from cflow_torch.applications.track_state import TrackStates
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import concat_ranges, unique_pairs
from cflow_torch.types import Window

_MIN_OVERLAP = 0.1  # least intersection over union of the voxels of two groups that match
_MIN_CLAIM = 0.5  # a track of N points claims a group if its box holds at least 0.5 N points of the group
MIN_STOPPED_SHARE = 0.3  # a track of N points has stopped if its box holds at least 0.3 N static points
MARGIN = 0.2  # metres, added to length, width and height of boxes around the visible points of an object
_ROUNDING = 1e-3  # metres, added to the reach of a box
_ORIGIN_INSIDE = 0.5  # metres, at least, from the origin of a vehicle to its sides
_REACH = 2.7  # metres from the origin of the vehicle to the farthest of its returns
_LEAST_RIDE, _RIDE_ERROR = 0.2, 0.1  # metres per sweep, faster than people walk; share by which flow is off
VOXELS = (0.3, 0.6, 1.2)  # metres, sides; sparse groups share only large voxels with the next sweep
_HEIGHT = 3.0  # ratio of a voxel's height to its side: the beams hit an object at different heights in each sweep


class TrackMatches(NamedTuple):
    """Tracks that are seen in a sweep: `track[i]` continues as moving group `group[i]`; `stopped` tracks are static."""

    track: Tensor  # (M,) int64
    group: Tensor  # (M,) int64
    stopped: Tensor  # (S,) int64 tracks
    num_points: Tensor  # (S,) int64 points in the boxes of the stopped tracks
    track_of_static: Tensor  # (P,) int64, the stopped track whose box holds each static point, -1 = none


def regroup(groups: MovingGroups, tracks: TrackStates) -> MovingGroups:
    """Correct the moving groups of a sweep with the predicted boxes of confirmed tracks."""
    known = tracks.take(tracks.is_confirmed)
    box = box_of_point(groups.point, known.box, known.size + MARGIN, known.heading)
    return _divide(_make_pieces_static(groups, box, known.num_points), box, known.num_points)


def of_own_vehicle(groups: MovingGroups, sweeps: Window) -> Tensor:
    """Tell which points of sweep t belong to moving groups that are returns of its own vehicle, (M,) bool.

    They move as the vehicle does, and are around its origin, or near the vehicle if it drives faster than people walk.
    The place alone does not tell: a car below a bridge is around the origin of a sensor on it. Nor do sweeps without
    poses.
    """
    if sweeps.pc0.pose is None or sweeps.pc1.pose is None:
        return torch.zeros_like(groups.moves)
    flow = groups.mean(groups.step)
    heading = torch.atan2(flow[:, 1], flow[:, 0])
    centre, size = enclosing_boxes(*groups.moving, heading)
    T_world_ego0, T_world_ego1 = (centre.new_tensor(pose_of(sweep)) for sweep in (sweeps.pc0, sweeps.pc1))
    offset = turned(T_world_ego0[:3, 3] - centre, -heading)[:, :2].abs()
    holds_origin = (offset <= size[:, :2] / 2 + _ORIGIN_INSIDE).all(1)

    motion = T_world_ego1 @ torch.linalg.inv(T_world_ego0)
    ride = centre @ motion[:3, :3].T + motion[:3, 3] - centre  # of a point that is fixed to the vehicle
    distance = ride.norm(dim=1)
    rides = (flow - ride).norm(dim=1) <= _RIDE_ERROR * distance
    is_near = (offset + size[:, :2] / 2).norm(dim=1) <= _REACH
    is_own = rides & (holds_origin | is_near & (distance >= _LEAST_RIDE))
    return Groups(groups.group, len(is_own)).where(groups.moves).spread(is_own)


def _make_pieces_static(groups: MovingGroups, box: Tensor, num_points: Tensor) -> MovingGroups:
    """Make a moving group static if it is a small piece of a confirmed object that has stopped.

    While the vehicle passes a stopped object, the visible outline of the object changes. A piece of the object then
    seems to move, and the track would follow this piece. We recognise a piece of an object of `num_points` points by
    the box of the object. It holds more than half of the points of the group, which has fewer points than a stopped
    object, and more static points than the group has points. A person next to a wall has as many points as before, so
    a person is not a piece.
    """
    is_inside = box >= 0
    num_static = torch.bincount(box[is_inside & ~groups.moves], minlength=len(num_points))
    moves_inside = is_inside & groups.moves
    group, box, _, count = unique_pairs(groups.group[moves_inside], box[moves_inside])
    size = groups.count[group]
    is_piece = (count > size / 2) & (size < num_static[box]) & (size < MIN_STOPPED_SHARE * num_points[box])
    return groups.divide(torch.where(torch.isin(groups.group, group[is_piece]), -1, 0))


def _divide(groups: MovingGroups, box: Tensor, num_points: Tensor) -> MovingGroups:
    """Divide moving groups that hold several confirmed objects, such as two cars side by side.

    An object of `num_points` points claims a group if its box holds at least half as many points of the group. If
    several objects claim a group, we give the points in their boxes to them, and the other points to the last of them.
    """
    group, box, pair_of_point, count = unique_pairs(groups.group[groups.moves], box[groups.moves])
    claims = count >= _value_of_box(_MIN_CLAIM * num_points, box, torch.inf)
    piece = torch.where(claims, box + 1, 0)
    last = torch.zeros_like(groups.count).scatter_reduce(0, group, piece, "amax")
    is_divided = torch.bincount(group[claims], minlength=len(groups.count)) > 1
    piece = torch.where(is_divided[group], torch.where(claims, piece, last[group]), 0)
    return groups.divide(torch.zeros_like(groups.group).masked_scatter(groups.moves, piece[pair_of_point]))


def _value_of_box(values: Tensor, box: Tensor, outside: float) -> Tensor:
    """Return the value of each box, (N,) int64, from those of K boxes, (K,); `outside` for box -1."""
    return Groups(box, len(values)).where(box >= 0).spread(values, none=outside)


def match(tracks: TrackStates, points: Tensor, track_of_point: Tensor, groups: MovingGroups) -> TrackMatches:
    """Match tracks with a sweep, given the predicted points (P, 3) of the tracks and the track of each point."""
    track, group = link(points, track_of_point, *groups.moving)
    may_have_stopped = tracks.is_confirmed.clone()
    may_have_stopped[track] = False
    candidate = may_have_stopped.nonzero()[:, 0]
    candidates = tracks.take(candidate)
    box = box_of_point(groups.point[~groups.moves], candidates.box, candidates.size + MARGIN, candidates.heading)
    count = torch.bincount(box[box >= 0], minlength=len(candidate))
    has_stopped = count >= (MIN_STOPPED_SHARE * candidates.num_points).clamp(min=MIN_POINTS)
    return TrackMatches(
        track=track,
        group=group,
        stopped=candidate[has_stopped],
        num_points=count[has_stopped],
        track_of_static=_value_of_box(torch.where(has_stopped, candidate, -1), box, -1),
    )


def link(points0: Tensor, group0: Tensor, points1: Tensor, group1: Tensor) -> tuple[Tensor, Tensor]:
    """Match groups of two sweeps that share small voxels, one to one, then the remaining groups in larger voxels.

    Points are (N, 3) float64, metres. The points of the earlier sweep are already at their predicted positions in the
    current one. The group of each point is (N,) int64, counted from 0. The voxels of two groups that match overlap
    by `_MIN_OVERLAP` or more, as intersection over union. Returns the matched groups of the earlier and of the current
    sweep, (K,) int64 each.

    Convention: greedy, the largest overlap first. Ties: the smaller earlier group, then the smaller current one.
    Cost: for each size of voxel, four sorts of the points.
    """
    matches: dict[int, int] = {}
    taken: set[int] = set()
    for side in VOXELS:
        for earlier, current in _by_overlap(points0, group0, points1, group1, side):
            if earlier not in matches and current not in taken:
                matches[earlier] = current
                taken.add(current)
    matched = torch.tensor([*matches.items()], dtype=torch.int64, device=points0.device).view(-1, 2)
    return matched[:, 0], matched[:, 1]


def _by_overlap(points0: Tensor, group0: Tensor, points1: Tensor, group1: Tensor, side: float) -> list[list[int]]:
    """Pairs of groups (earlier, current) that share voxels of `side` metres, the largest overlap first."""
    if not (len(points0) and len(points1)):
        return []
    both = torch.cat([points0, points1])
    cell = (both / both.new_tensor((side, side, _HEIGHT * side))).floor().long()
    count = cell.amax(0) - cell.amin(0) + 1
    x, y, z = (cell - cell.amin(0)).unbind(1)
    voxel = (x * count[1] + y) * count[2] + z
    voxel0, group0 = _distinct(voxel[: len(points0)], group0)
    voxel1, group1 = _distinct(voxel[len(points0) :], group1)
    begin = torch.searchsorted(voxel1, voxel0)
    count = torch.searchsorted(voxel1, voxel0, right=True) - begin
    earlier, current, _, shared = unique_pairs(group0.repeat_interleave(count), group1[concat_ranges(begin, count)])
    share = shared / (torch.bincount(group0)[earlier] + torch.bincount(group1)[current] - shared)
    order = share.argsort(descending=True, stable=True)
    order = order[share[order] >= _MIN_OVERLAP]
    return torch.stack([earlier[order], current[order]], 1).tolist()  # type: ignore[no-any-return]


def _distinct(voxel: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct pairs of voxel and group, (K,) int64 each, in order of voxel."""
    first, second, _, _ = unique_pairs(voxel, group)
    return first, second


def box_of_point(points: Tensor, centre: Tensor, size: Tensor, heading: Tensor) -> Tensor:
    """(N,) int64 index of the first of K upright boxes that holds each of (N, 3) finite float64 points, -1 = none.

    The (K, 3) sizes are length, width, height; the length is along `heading`, (K,) radians. Cost: one sort of the
    points, then for each box the points of its strip of x.
    """
    by_x = points[:, 0].argsort()
    box = torch.full_like(by_x, -1)
    rows = list(points_in_boxes(points[by_x], centre, size, heading))
    for number in reversed(range(len(rows))):  # so that the first box wins
        box[by_x[rows[number]]] = number
    return box


def points_in_boxes(points: Tensor, centre: Tensor, size: Tensor, heading: Tensor) -> Iterator[Tensor]:
    """Yield the rows of the (N, 3) finite points, sorted by x, that are in each of K boxes, see `box_of_point`."""
    reach = size[:, :2].norm(dim=1) / 2 + _ROUNDING
    x = points[:, 0].contiguous()
    first = torch.searchsorted(x, centre[:, 0] - reach).tolist()
    last = torch.searchsorted(x, centre[:, 0] + reach).tolist()
    for number, (begin, end) in enumerate(zip(first, last)):
        offset = turned(points[begin:end] - centre[number], -heading[number])
        yield begin + (offset.abs() <= size[number] / 2).all(1).nonzero()[:, 0]


def enclosing_boxes(points: Tensor, group: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    """Return the centres and the sizes, (K, 3) float64 each, of upright boxes around K groups.

    `group` is the group of each point, (N,), and `heading` the direction of each box, (K,) radians. No group is empty.
    """
    local = turned(points, -heading[group])
    index = group[:, None].expand(-1, 3)
    extremes = local.new_zeros(len(heading), 3)
    low = extremes.scatter_reduce(0, index, local, "amin", include_self=False)
    high = extremes.scatter_reduce(0, index, local, "amax", include_self=False)
    middle = (low + high) / 2
    return turned(middle, heading), high - low


def turned(values: Tensor, angle: Tensor) -> Tensor:
    """Rotate (..., 3) vectors by (...) angles about z, counter-clockwise, radians."""
    x, y, z = values.unbind(-1)
    cos = angle.cos()
    sin = angle.sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
