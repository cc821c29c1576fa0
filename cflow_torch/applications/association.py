"""Associate the tracks of a drive with the moving groups and the static points of its next sweep."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.applications.linking import box_of_point, link
from cflow_torch.applications.moving_groups import MIN_POINTS, MovingGroups
from cflow_torch.applications.track_state import Tracks
from cflow_torch.ops.indices import lookup

_MIN_SHARE = 0.1  # of common voxels, for a match of two groups
_MIN_CLAIM = 0.5  # of a track's points, which must lie in its box for a claim on a group that holds several objects
_MIN_STOPPED_SHARE = 0.3  # of a track's points, which must lie in its box for the object to have stopped there
_MARGIN = 0.2  # metres by which that box is larger


class Matches(NamedTuple):
    """Tracks that explain a sweep: track i continues in moving group i, or has stopped."""

    track: Tensor  # (M,) int64
    group: Tensor  # (M,) int64
    stopped: Tensor  # (S,) int64 tracks
    num_points: Tensor  # (S,) int64 points in the boxes of the stopped tracks
    track_of_static: Tensor  # (P,) int64 for each static point the stopped track whose box holds it, -1 = none


def divide(groups: MovingGroups, tracks: Tracks) -> MovingGroups:
    """Divide moving groups that hold several confirmed objects, such as two cars side by side.

    An object claims a group if the box in which we expect it holds half as many points of the group as the object had.
    A group with several claims is divided: points go to the box that holds them, all others to one of the claims.
    """
    moves = groups.group >= 0
    known = tracks.is_confirmed.nonzero()[:, 0]
    box = box_of_point(groups.point[moves], tracks.box[known], tracks.size[known] + _MARGIN, tracks.heading[known])
    pairs = torch.stack([groups.group[moves], box])
    (group, box), pair_of_point, count = torch.unique(pairs, dim=1, return_inverse=True, return_counts=True)
    least = lookup(_MIN_CLAIM * tracks.num_points[known], torch.where(box < 0, len(known), box), torch.inf)
    claims = count >= least
    part = torch.where(claims, box + 1, 0)
    last = torch.zeros_like(groups.count).scatter_reduce(0, group, part, "amax")
    is_divided = torch.bincount(group[claims], minlength=len(groups.count)) > 1
    part = torch.where(is_divided[group], torch.where(claims, part, last[group]), 0)
    return groups.divide(part[pair_of_point])


def match(tracks: Tracks, points: Tensor, owner: Tensor, groups: MovingGroups) -> Matches:
    """Match tracks, with (P, 3) points and the track of each, to the moving groups and static points of a sweep."""
    moves = groups.group >= 0
    track, group = link(points, owner, groups.point[moves], groups.group[moves], _MIN_SHARE)
    may_have_stopped = tracks.is_confirmed.clone()
    may_have_stopped[track] = False
    candidate = may_have_stopped.nonzero()[:, 0]
    static = groups.point[~moves]
    box = box_of_point(static, tracks.box[candidate], tracks.size[candidate] + _MARGIN, tracks.heading[candidate])
    count = torch.bincount(box[box >= 0], minlength=len(candidate))
    has_stopped = count >= (_MIN_STOPPED_SHARE * tracks.num_points[candidate]).clamp(min=MIN_POINTS)
    track_of_box = torch.where(has_stopped, candidate, -1)
    track_of_static = lookup(track_of_box, torch.where(box < 0, len(candidate), box), -1)
    return Matches(track, group, candidate[has_stopped], count[has_stopped], track_of_static)
