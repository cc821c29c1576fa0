"""The base class of all methods: collate windows, estimate the motion of their points, return results."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Sequence, TypeVar

import torch
from torch import Tensor, nn

from cflow_torch.config import METHODS, PRESETS, Config, make_config
from cflow_torch.diagnosis.inspection import inactive_problems
from cflow_torch.errors import warn
from cflow_torch.ops.threads import one_thread
from cflow_torch.stages import stage
from cflow_torch.tensors import choose_device
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch, make_batch
from cflow_torch.windows.memory import split_windows
from cflow_torch.windows.validation import check_windows, keep_nearest

_Model = TypeVar("_Model", bound="SceneFlowModel")


@dataclass(frozen=True)
class Motion:
    """Motion of M clusters of points. Entry M means "no cluster": motion 0, id -1, score 0."""

    cluster_of_cell: Tensor  # (Q,) int32 or int64, cluster of each cell (a pixel of a sweep, or a point), M = none
    cell_of_point: Tensor  # (P,) int64, cell of each point; ignored points have a cell without a cluster
    flow: Tensor  # (M + 1, 3) float64, metres per sweep interval, axes of ego1
    cluster_id: Tensor  # (M + 1,) int64, counted from 0 in each window
    score: Tensor  # (M + 1,) float32
    confidence: Tensor | None = None  # (M + 1,) float32, see `FlowResult`; None = the method does not estimate it
    moving: Tensor | None = None  # (M + 1,) float32, likewise
    # (A, P) float64, metres per sweep interval, flow of each point summed over coarser scales; None = no coarser scale.
    before: Tensor | None = None
    corrected: Batch | None = None  # the batch with the ego motion that the method found; None = it takes that given

    def cluster(self, points: slice) -> Tensor:
        """Return the cluster of each point in a slice; M = no cluster."""
        return self.cluster_of_cell.index_select(0, self.cell_of_point[points])

    def flow_of(self, cluster: Tensor, out: Tensor) -> Tensor:
        """Write x, y (and z) of the flow of K clusters to `out`, (A, K) float64, and return it."""
        for values, of_cluster in zip(out.unbind(0), self.flow.unbind(1)):
            torch.index_select(of_cluster, 0, cluster, out=values)
        return out

    def residual_flow(self, points: slice, positions: Tensor) -> Tensor:
        """Return the flow of the K points of a slice, (K, 3) float32.

        Only clusters that rotate need `positions`, (A, K) float64 in metres, A = `num_axes` of the method.
        """
        cluster = self.cluster(points)
        if self.before is None:
            return self.flow.float().index_select(0, cluster)
        before = self.before[:, points]
        residual = torch.zeros((cluster.numel(), 3), dtype=torch.float32, device=cluster.device)
        total = self.flow_of(cluster, out=torch.empty_like(before)).add_(before)
        for of_axis, values in zip(residual.unbind(1), total.unbind(0)):
            of_axis.copy_(values)
        return residual


class SceneFlowModel(nn.Module):
    """Base class of the methods. A method sets the class attributes and implements `motion`. It has no state.

    Args:
        config: settings of the method; `from_preset` makes them from a preset.
        device: "auto" = the device of the tensors, else a GPU if there is one, else the CPU. `model.to(device)` does
            not change it, because a method has no weights.

    Raises:
        CFlowError: `config` is not a `Config`, or it is the config of another method.
    """

    method = ""
    num_axes = 2  # coordinates of points that the method needs; 2 = x and y
    needs_ground = False  # the method needs the heights of ground points
    needs_times = False  # the method needs the times of points
    bytes_per_point = 160  # of working memory before clusters are known: positions, pixels, temporaries

    def __init__(self, config: Config, device: Any = "auto") -> None:
        super().__init__()
        name = type(self).__name__
        if not isinstance(config, Config):
            raise CFlowError(
                f"config is {type(config).__name__}: give the result of make_config, or {name}.from_preset"
            )
        if not isinstance(config, METHODS[self.method]):
            raise CFlowError(
                f"{name} is method={self.method!r}, but the config is for {config.method!r}: use make_model"
            )
        self.config: Any = config
        self.device = device

    @classmethod
    def from_preset(
        cls: type[_Model], preset: str | Config | None = None, device: Any = "auto", **settings: Any
    ) -> _Model:
        """Make the method with the settings of a preset, with some fields replaced.

        `preset` is a preset of this method, or the result of `make_config`; None = "default", "paper" or "keypoints".
        An unknown preset or field, a preset of another method or an invalid value is a `CFlowError`.
        """
        if preset is None:
            preset = next(name for name, config in PRESETS.items() if config.method == cls.method)
        return cls(make_config(preset, **settings), device)

    def extra_repr(self) -> str:
        """Settings, for `print`."""
        return ", ".join(f"{name}={value!r}" for name, value in vars(self.config).items())

    def motion(self, batch: Batch) -> Motion:
        """Estimate the motion t -> t+1 of all points of a batch. Each method implements this."""
        raise NotImplementedError

    def grid(self, pixel_size: float) -> Grid:
        """The BEV grid of a pixel size, metres. It contains `point_cloud_range`, and only points there get flow."""
        bounds = self.config.point_cloud_range
        return Grid(pixel_size, bounds[:3], bounds[3:])

    def __call__(self, windows: Sequence[Window], warns: bool = True) -> list[FlowResult]:
        """Estimate the flow of every window, see `forward`."""
        return super().__call__(windows, warns)  # type: ignore[no-any-return]

    def forward(self, windows: Sequence[Window], warns: bool = True) -> list[FlowResult]:
        """Estimate the flow t -> t+1 of the points of every window's pc0.

        Args:
            windows: B windows, of any numbers of points and sweeps.
            warns: False = give no warning, because you check the results by `inactive_problems`.

        Returns:
            B results. Each depends only on its window and the settings.

        Warns:
            CFlowWarning: no point of a pc0 is active. `Inspection` warns of other likely mistakes; `estimate_flow` and
                `FlowStream` call it.

        Convention: `torch.compile` does not change the model. Shapes differ from window to window, so compiling would
            not pay.

        Cost: one CPU thread, whatever the number of threads of torch. To use more cores, start more processes.

        Raises:
            CFlowError: bad input, see `make_batch`.
        """
        dynamo = sys.modules.get("torch._dynamo")  # loaded if anyone compiles; an import takes seconds
        estimate = self._estimate if dynamo is None else dynamo.disable(self._estimate)
        return estimate(windows, warns)  # type: ignore[no-any-return]

    @torch.no_grad()
    @one_thread()
    def _estimate(self, windows: Sequence[Window], warns: bool) -> list[FlowResult]:
        """Estimate the flow of every window, see `forward`."""
        check_windows(windows, self.config)
        windows = [keep_nearest(window, self.config.num_history) for window in windows]
        grid = self.grid(self.config.pixel_sizes[-1])
        device = choose_device(windows, self.device)
        results: list[FlowResult] = []
        with torch.autocast(device.type, enabled=False):  # counts would lose bits
            for some in split_windows(windows, grid, device, self.bytes_per_point, self.config.max_memory):
                with torch.inference_mode():  # a tenth faster than no_grad: the work is many small operations
                    with stage("compensate"):
                        batch = make_batch(
                            some, self.config, grid, device, self.num_axes, self.needs_ground, self.needs_times
                        )
                    motion = self.motion(batch)
                with stage("spread"):  # outside of inference mode: a training loop may use these tensors
                    results += _results(batch, motion)
        for problem in inactive_problems(windows, results, self.config) if warns else ():
            if problem:
                warn(problem)
        return results


def _results(batch: Batch, motion: Motion) -> list[FlowResult]:
    """One result per window, for all rows of its pc0."""
    batch = batch if motion.corrected is None else motion.corrected
    points = slice(batch.rows[0].start, batch.rows[-1].stop)
    cluster = motion.cluster(points)
    is_valid = batch.has_result[points].clone()
    residual = motion.residual_flow(points, batch.positions[:, points]).add_(0.0)  # turns -0.0 into 0.0
    cluster_id, score = (values.index_select(0, cluster) for values in (motion.cluster_id, motion.score))
    given = (motion.confidence, motion.moving)
    is_left_out = ~is_valid
    probabilities = [
        None if values is None else values.index_select(0, cluster).masked_fill_(is_left_out, 0.0) for values in given
    ]
    columns = (residual, batch.pose_flow, residual + batch.pose_flow, cluster_id, score, is_valid, *probabilities)
    sizes = [rows.stop - rows.start for rows in batch.rows]
    of_window = [[None] * len(sizes) if column is None else _divided(column, sizes) for column in columns]
    return [FlowResult(*fields) for fields in zip(*of_window)]


def _divided(values: Tensor, sizes: list[int]) -> list[Tensor]:
    """Divide rows into copies, so that a result that you keep or pickle does not hold the whole batch."""
    return [values] if len(sizes) == 1 else [part.clone() for part in values.split(sizes)]
