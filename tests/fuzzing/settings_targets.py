"""Settings: what is typed behind `cflow flow`, and the YAML that a run leaves."""

from __future__ import annotations

import copy
import os
import random
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, List, Tuple

import numpy as np
from hypothesis import strategies as st

from cflow_torch.cli.arguments import for_hydra
from cflow_torch.cli.settings_file import read_settings
from cflow_torch.types import CFlowError
from fuzzing.target import Target

SEEDS = [
    b"model.pixel_sizes=[0.4,0.2,0.1]\nmodel.num_history=2\ndevice=cpu\n",
    b"shard.index=2\nshard.count=16\nresume=false\n++model.max_speed=30.5\n",
    b"contents=[residual,is_valid]\nengine.workers=3\ndata.poses=null\ndata.suffix=.npy\n",
    b"model.point_cloud_range=[-35,-35,-inf,35,35,inf]\nmodel.ego_box=[-1,-1,3,1]\nresult_name=null\n",
]
NAMES = (
    *("model", "data", "engine", "shard", "shard.index", "shard.count", "device", "contents", "resume", "overwrite"),
    *("output", "result_name", "dry_run", "data.poses", "data.times", "data.ground", "data.suffix", "data.bin_columns"),
    *("data.ego_T_lidar", "data.find_ground", "data.odometry", "data.root", "data.name", "engine.workers", "hydra.x"),
    *("engine.threads", "engine.batch", "engine.timeout", "engine.name", "model.pixel_sizes", "model.method", "a.b"),
    *("model.max_memory", "model.point_cloud_range", "model.proof", "model.ego_box", "model.max_speed", "model.yaw"),
    *("model.patch_size", "model.zero_test", "model.keypoint_block", "model.sweep_interval", "model.clearance"),
    *("model._target_", "data._target_", "_target_", "data.calibration", "data.check", "data.poses_of", "model.x"),
)
VALUES = (
    *(
        "null",
        "true",
        "0",
        "-1",
        "1.5",
        "1e400",
        "nan",
        "-.inf",
        "inf",
        "9" * 400,
        "9" * 5000,
        "[]",
        "{}",
        "[[]]",
        "''",
    ),
    *("[null]", "[1,2,3]", "[1e999,a]", "{a:1}", "{_target_:os.system}", "os.system", "${nope}", "${output}", "???"),
    *("${oc.env:HOME}", "${oc.env:NO_SUCH_NAME}", "${oc.decode:'['}", "${oc.create:{a:1}}", "${model}", "${data.root}"),
    *(
        "${model.pixel_sizes}",
        "${${device}}",
        "${",
        "}",
        "'a",
        '"\\',
        "../../x",
        "/etc/passwd",
        "a b",
        "\u00e9",
        "\0",
        "a\0b",
    ),
    *("!!python/object/apply:os.system [x]", "&a [*a]", "range(3)", "choice(1,2)", "[" * 60 + "]" * 60, "x" * 3000),
)


@lru_cache(maxsize=None)
def _composed() -> Any:
    from hydra import compose, initialize_config_module

    os.environ.pop("NO_SUCH_NAME", None)
    with initialize_config_module("cflow_torch.configs", version_base="1.3"):
        return compose("flow", ["data=arrays"])


def _prepare(folder: Path) -> None:
    (folder / "log").mkdir()
    for index in range(2):
        np.save(folder / "log" / f"{index:06d}.npy", np.arange(12, dtype=np.float32).reshape(4, 3))


def _read_overrides(folder: Path) -> None:
    """As `cflow flow` does, up to the first sweep."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf.errors import OmegaConfBaseException

    from cflow_torch.cli import settings, wrong_call

    lines = (folder / "overrides").read_bytes().decode("utf-8", "replace").split("\n")[:20]
    cfg, has_begun = copy.deepcopy(_composed()), False
    try:
        parsed = OverridesParser.create().parse_overrides(for_hydra([line for line in lines if line]))
        ConfigLoaderImpl._apply_overrides_to_config(
            [override for override in parsed if "/" not in override.key_or_group], cfg
        )
        settings.check_shape(cfg, "flow")
        has_begun = True
        if cfg.data.name == "arrays":
            cfg.data.root, cfg.output = str(folder / "log"), str(folder / "output")
        _begin(cfg)
    except CFlowError:
        raise
    except Exception as error:
        mine = has_begun and not isinstance(error, OmegaConfBaseException)
        message = None if mine else wrong_call.explain(error, "flow")
        if message is None and not (isinstance(error, OSError) and error.filename):
            raise
        raise CFlowError(message or str(error)) from error


def _begin(cfg: Any) -> None:
    from omegaconf import OmegaConf

    from cflow_torch.cli.flow import _contents
    from cflow_torch.cli.run import find_logs, make_model, output_folder
    from cflow_torch.data.catalog import open_log
    from cflow_torch.fleet.machine import choose_layout
    from cflow_torch.fleet.manifest import find_conflict, make_identity
    from cflow_torch.fleet.shard import find_shard

    output = output_folder(cfg)
    shard = find_shard(cfg.shard.index, cfg.shard.count, {})
    engine: Any = OmegaConf.to_container(cfg.engine, resolve=True)
    choose_layout(cfg.device, engine["workers"], engine["threads"], engine["batch"], {})
    config = make_model(cfg).config
    if cfg.data.name in ("synthetic", "benchmark"):
        raise CFlowError("simulated drives take long")
    sources = find_logs(cfg)
    identity = make_identity(config, sources.reader, sources.settings, _contents(cfg, config.proof))
    find_conflict(output, identity, cfg.resume or cfg.overwrite)
    for unit in shard.units(sources.logs):
        open_log(sources.reader, unit.source, **{**sources.settings, "check": False})


@st.composite
def _overrides(draw: Callable[..., object]) -> bytes:
    chance = random.Random(draw(st.integers(0, (1 << 64) - 1)))
    lines = chance.choice(SEEDS).decode().splitlines()[: chance.randrange(3)]
    for _ in range(chance.choice((1, 1, 2))):
        sign = chance.choice(("", "", "", "", "+", "++", "~"))
        lines.append(f"{sign}{chance.choice(NAMES)}={chance.choice(VALUES)}")
    return "\n".join(lines).encode()


# ------------------------------------------------------------------------------------------------------ config.yaml

YAMLS = (
    *(
        "!!python/object/apply:os.system ['x']",
        "!!python/name:os.system",
        "!!binary AAAA",
        "!!set {a}",
        "!x y",
        "&a [*a]",
    ),
    *(
        "&a [x,x]\nb: &b [*a,*a]\nc: [*b,*b]",
        "{_target_: os.system}",
        "${oc.env:HOME}",
        "${nope}",
        "9" * 5000,
        "0o7",
        ".nan",
    ),
    *(
        "2024-13-45",
        "2024-01-01",
        "1:30:59",
        "[" * 2000,
        "[" * 100 + "]" * 100,
        "- " * 300,
        "? x",
        "'",
        '"\\x"',
        "\t",
        "|",
        "{a: ",
        "~",
    ),
)


def _settings_seeds() -> List[bytes]:
    return [
        b"version: 2\nmodel: {a: [1, 2.5, .inf]}\nframes: null\n",
        b"data:\n  root: 'a b'\n  poses:\n  - 1e5\n  - x\n",
    ]


@st.composite
def _yaml(draw: Callable[..., object]) -> bytes:
    chance = random.Random(draw(st.integers(0, (1 << 64) - 1)))
    lines = chance.choice(_settings_seeds()).decode().splitlines()
    for _ in range(chance.choice((1, 1, 2))):
        lines.insert(
            chance.randrange(len(lines) + 1),
            f"{chance.choice(('version', 'x', '  y', '- z', '?'))}: {chance.choice(YAMLS)}",
        )
    return "\n".join(lines).encode(chance.choice(("utf-8",) * 9 + ("utf-16", "latin-1")), "replace")


WORDS: Tuple[bytes, ...] = (
    b"${",
    b"}",
    b"[",
    b"]",
    b"{",
    b"=",
    b"model.",
    b"data.",
    b"!!",
    b"&a",
    b"*a",
    b"null",
    b"~",
    b"+",
)
_NEEDS = "cflow_torch.configs"  # part of an installed package
TARGETS: Tuple[Target, ...] = (
    Target("overrides", "overrides", lambda: SEEDS, _read_overrides, _prepare, _overrides(), WORDS, _NEEDS),
    Target(
        *("settings_file", "config.yaml", _settings_seeds, lambda folder: read_settings(folder / "config.yaml")),
        crafted=_yaml(),
        tokens=WORDS,
        needs=_NEEDS,
    ),
)
