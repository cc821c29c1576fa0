"""Estimate flow with one call: two point clouds in, flow out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Sequence

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.errors import warn
from cflow_torch.ground.segmentation import CHOICES, find_ground_batch
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.model import SceneFlowModel
from cflow_torch.tensors import choose_device
from cflow_torch.types import Array, CFlowError, FlowResult, Sweep, Window, check_sweep
from cflow_torch.verified.method import VerifiedFlow
from cflow_torch.windows.returns import MISSING, without_missing
from cflow_torch.windows.validation import keep_nearest

# Arguments of `estimate_flow` that a `Sweep` contains.
_NOT_WITH_SWEEPS = ("T_ego1_ego0", "gm0", "gm1", "dt0", "dt1", "T_ego1_egoh", "gmh", "dth", "T_ego1_egof", "gmf", "dtf")


def estimate_flow(
    pc0: Array | Sweep,  # (N0, 3+), metres, ego frame of sweep t
    pc1: Array | Sweep,  # (N1, 3+), metres, ego frame of sweep t+1
    *,
    T_ego1_ego0: Array | None = None,  # (4, 4)
    gm0: Array | None = None,  # (N0,) bool
    gm1: Array | None = None,  # (N1,) bool
    pch: Sequence[Array | Sweep] = (),  # (Nh, 3+) each, nearest first
    T_ego1_egoh: Sequence[Array | None] = (),
    gmh: Sequence[Array | None] = (),
    dt0: Array | None = None,  # (N0,), seconds
    dt1: Array | None = None,  # (N1,), seconds
    dth: Sequence[Array | None] = (),
    pcf: Sequence[Array | Sweep] = (),  # (Nf, 3+) each, nearest first
    T_ego1_egof: Sequence[Array | None] = (),
    gmf: Sequence[Array | None] = (),
    dtf: Sequence[Array | None] = (),
    method: str | None = None,
    preset: str | None = None,
    config: Config | None = None,
    ground: str | None = "auto",
    device: Any = "auto",
    **overrides: Any,
) -> FlowResult:
    """Estimate the scene flow from sweep t to sweep t+1.

    Args:
        pc0: points of sweep t, (N0, 3+) float of any width, array or tensor. Columns after z are ignored. Or a `Sweep`,
            which also contains mask, pose and times; then all of `pc0`, `pc1`, `pch` and `pcf` must be sweeps.
        pc1: points of sweep t+1, (N1, 3+).
        T_ego1_ego0: (4, 4), maps the ego frame at t to the ego frame at t+1 (pose1^-1 pose0). None = pc0 is already in
            the frame of t+1.
        gm0, gm1: ground masks, (N,) bool, True = ground; None = see `ground`.
        pch: older sweeps t-1, t-2, ...; we use the nearest `num_history` of them.
        T_ego1_egoh: (4, 4) for each of `pch`; may be left out only if `T_ego1_ego0` is left out too.
        gmh: ground mask of each of `pch`, or empty.
        dt0, dt1: times of the points, seconds after the instant of their sweep, see `Sweep.point_times`. The presets
            `default`, `offline` and `live` use them if every sweep has them.
        dth: times of the points of each of `pch`.
        pcf, T_ego1_egof, gmf, dtf: sweeps t+2, t+3, ..., at most `num_future`, with their transforms, masks and times;
            for the preset "offline".
        method: "dense", "keypoints" or "verified"; None = the method of the preset.
        preset: "default", "offline", "live", "keypoints" or "paper"; None = the preset of the method, or "default".
        config: settings from `make_config`, instead of `method` and `preset`.
        ground: what to do with sweeps without a mask. "grid" = find their ground (`find_ground`); "auto" = the same,
            with a warning; "patchwork" = use Patchwork++ (`pip install pypatchworkpp`); None = no point is ground.
        device: "auto" = the device of the tensors, else a GPU if there is one, else the CPU.
        **overrides: any field of `Config`, for example `pixel_sizes=(0.4, 0.2, 0.1)`.

    Returns:
        Flow for every row of pc0, in the axes of the ego frame at t+1, on the device of the computation.

    Convention:
        NaN and infinite points, missing returns (see `missing_returns` of cflow_torch.windows.returns), ground and
        points outside `point_cloud_range` get residual flow 0, cluster -1 and `is_valid` False. Empty sweeps give an
        empty or all-zero result.

    Warns:
        CFlowWarning: we left out missing returns; a sweep has no mask, so we found its ground (`ground="auto"`); a
            likely mistake in the input, see `SceneFlowModel.forward`; `is_valid` is False for all points of pc0.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, mixed devices, an unknown setting.

    Examples:
        >>> car = 0.1 * np.stack(np.meshgrid(range(45), range(18), range(15)), -1).reshape(-1, 3) + 5.05  # (12150, 3)
        >>> result = estimate_flow(car, car + [0.5, 0.0, 0.0])
        >>> result.residual_flow[0]  # metres until the next sweep
        tensor([0.5000, 0.0000, 0.0000])

    Source: Alg. general_correlation_flow; Sec. CorrelationFlow-Keypoints.
    """
    arguments = dict(locals())
    if ground not in CHOICES:
        raise CFlowError(f"ground={ground!r}: give one of {', '.join(map(repr, CHOICES))}")
    if config is None:
        config = make_config(preset, method, **overrides)
    elif not isinstance(config, Config) or (preset, method) != (None, None):
        raise CFlowError("config is the result of make_config, and replaces preset and method: leave these out")
    elif overrides:
        config = config.replace(**overrides)
    given = None if T_ego1_ego0 is None else "T_ego1_ego0"  # name of a transform that is given
    if given is None and any(transform is not None for transform in (*T_ego1_egoh, *T_ego1_egof)):
        given = "another transform"
    if isinstance(pc0, Sweep) or isinstance(pc1, Sweep):
        extra = [name for name in _NOT_WITH_SWEEPS if arguments[name] is not None and len(arguments[name]) > 0]
        if extra:
            raise CFlowError(f"{', '.join(extra)} and a Sweep are given: put masks, poses and times into the Sweep")
        window = Window(pc0, pc1, tuple(pch), tuple(pcf))  # type: ignore[arg-type]  # it refuses arrays
    else:
        window = Window(
            pc0=_sweep("0", given, pc0, gm0, T_ego1_ego0, dt0),
            pc1=_sweep("1", given, pc1, gm1, None, dt1),
            pch=_sweeps(given, "h", pch, gm=gmh, T_ego1_ego=T_ego1_egoh, dt=dth),
            pcf=_sweeps(given, "f", pcf, gm=gmf, T_ego1_ego=T_ego1_egof, dt=dtf),
        )
    window = _leave_out_missing(keep_nearest(window, config.num_history))
    window = _find_ground(window, ground, device)
    return make_model(config, device)([window])[0]


def make_model(config: Config, device: Any = "auto") -> SceneFlowModel:
    """Make the method of a config: `CorrelationFlow`, `CorrelationFlowKeypoints` or `VerifiedFlow`.

    `make_config` makes the config. `device` is as for `estimate_flow`.
    """
    methods = {method.method: method for method in (CorrelationFlow, CorrelationFlowKeypoints, VerifiedFlow)}
    if not isinstance(config, Config):
        raise CFlowError(f"config is {type(config).__name__}: give the result of make_config")
    return methods[config.method](config, device)


def _leave_out_missing(window: Window) -> Window:
    """Leave out points that are no returns, and say so."""
    kept = [without_missing(sweep) for sweep in (window.pc0, window.pc1, *window.pch, *window.pcf)]
    num_missing = max(count for _, count in kept)
    if num_missing == 0:
        return window
    warn(f"up to {num_missing} {MISSING}, so we leave them out")
    return _window([sweep for sweep, _ in kept], len(window.pch))


def _window(sweeps: Sequence[Sweep], num_history: int) -> Window:
    """Make a window of sweeps in the order t, t+1, t-1, ..., t+2, ..."""
    first_future = 2 + num_history
    return Window(sweeps[0], sweeps[1], tuple(sweeps[2:first_future]), tuple(sweeps[first_future:]))


def _find_ground(window: Window, ground: str | None, device: Any) -> Window:
    """Add the missing ground masks."""
    sweeps = [window.pc0, window.pc1, *window.pch, *window.pcf]
    bare = [index for index, sweep in enumerate(sweeps) if sweep.is_ground is None]
    clouds = [sweeps[index].points for index in bare]
    if ground is None:
        masks: list[Any] = [np.zeros(len(cloud), dtype=bool) for cloud in clouds]
    else:
        masks = find_ground_batch(clouds, ground, device=choose_device([window], device))
    if ground == "auto" and any(bool(mask.any()) for mask in masks):
        warn(
            "there is no ground mask for some sweeps, so we found their ground. To turn this line off give masks (gm0, "
            "gm1), ground='grid' (the same result), or ground=None if the clouds have no ground"
        )
    for index, mask in zip(bare, masks):
        sweeps[index] = replace(sweeps[index], is_ground=mask)
    return _window(sweeps, len(window.pch))


def _sweep(
    name: str, given: str | None, points: Array, is_ground: Any, transform: Array | None, times: Array | None
) -> Sweep:
    """Make a sweep in a world that is the ego frame at t+1: its pose is `transform`, or None if none is given."""
    pose = None if given is None else np.eye(4) if transform is None else transform
    names = [f"{argument}{name}" for argument in ("pc", "gm", "T_ego1_ego", "dt")]
    check_sweep(names, points, is_ground, pose, times)
    return Sweep(points, is_ground, pose, point_times=times)


def _sweeps(given: str | None, side: str, clouds: Sequence[Any], **others: Sequence[Any]) -> tuple[Sweep, ...]:
    """The sweeps of one side, "h" (history) or "f" (future), from lists that are empty or have an entry per sweep."""
    if given is not None and len(clouds) > 0 and len(others["T_ego1_ego"]) == 0:
        raise CFlowError(
            f"{given} is given but T_ego1_ego{side} is not: give one transform per sweep of pc{side} "
            "(None for a sweep that is already in the frame of t+1)"
        )
    for name, values in others.items():
        if len(values) not in (0, len(clouds)):
            raise CFlowError(
                f"{name}{side} has {len(values)} entries for {len(clouds)} sweeps of pc{side}: give one per sweep"
            )
    columns = (values if len(values) > 0 else [None] * len(clouds) for values in others.values())
    return tuple(_sweep(f"{side}[{i}]", given, *row) for i, row in enumerate(zip(clouds, *columns)))
