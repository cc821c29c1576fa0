"""The chain closes: a small network that trains on our labels with SeFlow's loss gets better against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Dict

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cflow_torch import make_config, make_model
from cflow_torch.applications.labels import label_scene
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.simulator import make_drive

pytest.importorskip("h5py")
spatial = pytest.importorskip("scipy.spatial")

SIDE, PIXEL = 128, 0.5  # of the network's images: 64 m
TRUNCATED = 2.0  # metres; a point further from all others has no partner

Pair = Dict[str, Tensor]


def pairs_of(file: Path) -> list[Pair]:
    """Points of t after ego motion and of t+1 without ground, labels of both, true residual flow of t."""
    with HDF5Log(file) as log:
        return [_pair(log, index) for index in range(len(log) - 1)]


def _pair(log: HDF5Log, index: int) -> Pair:
    T = np.linalg.inv(log.poses[index + 1]) @ log.poses[index]
    pair: Pair = {}
    for name, number in (("0", index), ("1", index + 1)):
        points = log.values(number, "lidar").astype(np.float64)
        moved = points @ T[:3, :3].T + T[:3, 3] if name == "0" else points
        kept = ~log.values(number, "ground_mask") & (np.abs(moved[:, :2]).max(1) < SIDE * PIXEL / 2 - 1)
        pair["points" + name] = torch.from_numpy(moved[kept]).float()
        pair["label" + name] = torch.from_numpy(log.values(number, "dufocluster")[kept].astype(np.int64))
        if name == "0":
            pair["truth"] = torch.from_numpy((log.values(number, "flow") - (moved - points))[kept]).float()
    return pair


class TinyNetwork(nn.Module):
    """Two occupancy images in, a horizontal flow per pixel out; it begins with no flow at all."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for number, dilation in enumerate((1, 1, 2, 4)):
            layers += [nn.Conv2d(24 if number else 2, 24, 3, padding=dilation, dilation=dilation), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(24, 2, 1))
        nn.init.zeros_(self.layers[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.layers[-1].bias)  # type: ignore[arg-type]

    def forward(self, pair: Pair) -> Tensor:
        """(N, 3) flow of the points of t."""
        pixels = [((pair[f"points{k}"][:, :2] / PIXEL).floor().long() + SIDE // 2).unbind(1) for k in (0, 1)]
        images = torch.zeros(1, 2, SIDE, SIDE)
        for channel, (x, y) in enumerate(pixels):
            images[0, channel, y, x] = 1
        x, y = pixels[0]
        flow = self.layers(images)[0][:, y, x].t()
        return torch.cat([flow, torch.zeros(len(flow), 1)], 1)


def nearest(points: Tensor, others: Tensor) -> Tensor:
    """(N,) index of the nearest of the others."""
    return torch.from_numpy(spatial.cKDTree(others.detach().numpy()).query(points.detach().numpy())[1])


def chamfer(points: Tensor, others: Tensor) -> Tensor:
    """Mean squared distance to the nearest, both ways, of those that are near at all."""
    total = torch.zeros(())
    for here, there in ((points, others), (others, points)):
        squared = (here - there[nearest(here, there)]).square().sum(1)
        total = total + squared[squared <= TRUNCATED**2].mean()
    return total


def seflow_loss(pair: Pair, flow: Tensor) -> Tensor:
    """SeFlow's four terms: chamfer, that of what moves, still flow of the rest, one flow per group.

    The flow of a group is bounded below by the way from the point that is furthest from what moves at t+1 to there.
    """
    points, others, label = pair["points0"], pair["points1"], pair["label0"]
    moves, others_move = label > 0, pair["label1"] > 0
    loss = chamfer(points + flow, others) + flow[~moves].norm(dim=1).mean()
    if not moves.any() or not others_move.any():
        return loss
    loss = loss + chamfer((points + flow)[moves], others[others_move])
    way = others[others_move][nearest(points[moves], others[others_move])] - points[moves]
    group, found, length = label[moves], flow[moves], way.norm(dim=1)
    terms = []
    for number in group.unique():
        mine = group == number
        longest = way[mine][length[mine].clamp(max=4.4).argmax()]
        terms.append((found[mine] - longest).norm(dim=1))
    return loss + torch.cat(terms).mean()


def errors(network: nn.Module, pairs: list[Pair]) -> list[float]:
    """Mean end-point error of points that truly move, and of those that stand, metres."""
    with torch.no_grad():
        error = torch.cat([(network(pair) - pair["truth"]).norm(dim=1) for pair in pairs])
    moves = torch.cat([pair["truth"].norm(dim=1) >= 0.05 for pair in pairs])
    return [float(error[moves].mean()), float(error[~moves].mean())]


@pytest.mark.slow
def test_training_on_the_labels_decreases_the_error_on_a_drive_that_was_not_seen(tmp_path: Path) -> None:
    model, pairs = make_model(make_config("offline"), "cpu"), []
    for seed in (1, 2, 3):
        file = tmp_path / f"{seed}.h5"
        write_hdf5_scene(make_drive(seed, 8, "demo"), file)
        label_scene(file, model)
        pairs.append(pairs_of(file))
    train, valid = [*pairs[0], *pairs[1]], pairs[2]
    torch.manual_seed(0)
    network = TinyNetwork()
    before = errors(network, valid)
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(15):
        for number in torch.randperm(len(train)).tolist():
            optimizer.zero_grad()
            seflow_loss(train[number], network(train[number])).backward()
            optimizer.step()
    after = errors(network, valid)
    print(f"moving {before[0]:.3f} -> {after[0]:.3f} m, standing {before[1]:.3f} -> {after[1]:.3f} m")
    assert after[0] < 0.8 * before[0] and after[1] < 0.05
