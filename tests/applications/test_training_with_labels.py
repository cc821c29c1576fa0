"""A small network that trains on our labels with SeFlow's loss gets closer to the truth."""

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
MAX_DISTANCE = 2.0  # metres, between a point and its nearest neighbour in the chamfer distance

Pair = Dict[str, Tensor]


def load_pair(log: HDF5Log, index: int) -> Pair:
    """Points of t after ego motion and of t+1 without ground, labels of both, true residual flow of t."""
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
    """Maps two occupancy images to a horizontal flow per pixel, which is zero before training."""

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


def to_nearest(points: Tensor, others: Tensor) -> Tensor:
    """(N, 3) displacements to the nearest of the other points."""
    index = spatial.cKDTree(others.detach().numpy()).query(points.detach().numpy())[1]
    return others[torch.from_numpy(index)] - points


def chamfer(points: Tensor, others: Tensor) -> Tensor:
    """Mean squared distance to the nearest point in both directions, without points that have none nearby."""
    squared = [to_nearest(*pair).square().sum(1) for pair in ((points, others), (others, points))]
    return sum((each[each <= MAX_DISTANCE**2].mean() for each in squared), torch.zeros(()))


def seflow_loss(pair: Pair, flow: Tensor) -> Tensor:
    """SeFlow's four terms: chamfer distance of all points and of dynamic points, zero flow of static points, and in
    each group the displacement of the point that is farthest from the dynamic points of t+1."""
    points, others, label = pair["points0"], pair["points1"], pair["label0"]
    moves, target = label > 0, others[pair["label1"] > 0]
    loss = chamfer(points + flow, others) + flow[~moves].norm(dim=1).mean()
    if not moves.any() or not len(target):
        return loss
    displacement, terms = to_nearest(points[moves], target), []
    for number in label[moves].unique():
        group = label[moves] == number
        farthest = displacement[group].norm(dim=1).clamp(max=4.4).argmax()
        terms.append((flow[moves][group] - displacement[group][farthest]).norm(dim=1))
    return loss + chamfer((points + flow)[moves], target) + torch.cat(terms).mean()


def errors(network: nn.Module, pairs: list[Pair]) -> list[float]:
    """Mean end-point error of dynamic and of static points, metres."""
    with torch.no_grad():
        error = torch.cat([(network(pair) - pair["truth"]).norm(dim=1) for pair in pairs])
    moves = torch.cat([pair["truth"].norm(dim=1) >= 0.05 for pair in pairs])
    return [float(error[moves].mean()), float(error[~moves].mean())]


@pytest.mark.slow
def test_training_on_the_labels_decreases_the_error_on_another_drive(tmp_path: Path) -> None:
    model, pairs = make_model(make_config("offline"), "cpu"), []
    for seed in (1, 2, 3):
        file = tmp_path / f"{seed}.h5"
        write_hdf5_scene(make_drive(seed, 8, "demo"), file)
        label_scene(file, model)
        with HDF5Log(file) as log:
            pairs.append([load_pair(log, index) for index in range(len(log) - 1)])
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
    assert after[0] < 0.8 * before[0] and after[1] < 0.05
