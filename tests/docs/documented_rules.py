"""How the documented commands are run by a test: which are made smaller, which cannot be run here, and why."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Dict, Tuple


@dataclass(frozen=True)
class Rule:
    """What a test changes of the commands that match.

    Args:
        pattern: searched for in the text of the command.
        why: reason.
        add: words put behind; of two settings of one name the later counts.
        replace: text of the command -> text.
        slow: more than about ten seconds even so.
        needs: module without which the command is skipped.
        before: commands that a reader has run before.
    """

    pattern: str
    why: str
    add: str = ""
    replace: Tuple[Tuple[str, str], ...] = ()
    slow: bool = False
    needs: str = ""
    before: Tuple[str, ...] = ()


SMALL_BENCHMARK = "data.profile=demo data.num_drives=1 data.num_sweeps=3 data.first=1"
PAPER_RESULTS = f"cflow eval -m experiment=views {SMALL_BENCHMARK}"
SUBMIT = "cflow submit data=hdf5 version=3 model=paper"
BENCH = "cflow bench data=av2 data.root=LOG repeats=1 batches=[1] hdbscan=false reference=false"

# All that match are applied, in this order.
SHRUNK: Tuple[Rule, ...] = (
    Rule(
        r"^cflow (flow (contents|shard)|eval definition).* \.\.\.$",
        "the reader's data",
        replace=(("...", "data=av2 data.root=LOG"),),
    ),
    Rule(
        r"^torchrun",
        "two processes, the reader's data",
        replace=(
            ("--nproc_per_node=8", "--nproc_per_node=2"),
            ("...", "data=av2 data.root=/data/av2/val engine.workers=1"),
        ),
        slow=True,
    ),
    Rule(r"^cflow flow (?!.*engine=ray)", "processes take seconds to start", add="engine.workers=1 engine.threads=1"),
    Rule(r"shard\.count=16", "three pairs in all", replace=(("shard.count=16", "shard.count=3"),)),
    Rule(r"^cflow eval data=benchmark", "one small drive", add=SMALL_BENCHMARK),
    Rule(r"^cflow (plot|view)\b(?!.*(data=|num_sweeps))", "the street is shorter", add="data.num_sweeps=6"),
    Rule(
        r"^cflow plot .*num_sweeps=17 first=4",
        "two frames",
        replace=(("num_sweeps=17 first=4", "num_sweeps=6 first=3"),),
    ),
    Rule(r"^cflow view\b(?!.*flow=)", "an extra; any preset will do", add="model=fast", needs="rerun"),
    Rule(
        r"^cflow view flow=outputs/flow",
        "of an earlier command",
        before=("cflow flow data.num_sweeps=6 model=fast engine.workers=1",),
        needs="rerun",
        slow=True,
    ),
    Rule(r"^cflow demo", "the picture is of pair 3", add="data.num_sweeps=5"),
    Rule(
        r"^cflow (flow|eval|submit)\b(?!.*(model=|confidence|experiment=))",
        "any preset will do",
        add="model=fast",
    ),
    Rule(
        r"^cflow (eval|flow) (?!.*(data=|experiment=|--cfg|\.\.\.))", "one pair of the street", add="data.num_sweeps=2"
    ),
    Rule(
        r"^cflow bench",
        "timings repeat the same; HDBSCAN and the reference take seconds",
        add="repeats=1 batches=[1] hdbscan=false reference=false",
    ),
    Rule(r"^cflow bench(?!.*data=)", "eight sweeps of 100,000 points are made first", slow=True),
    Rule(r"^cflow bench data=benchmark_sensors", "no history", add="data.num_sweeps=3 data.first=0", slow=True),
    Rule(r"^cflow bench .*repeats=", "one in a run of the quick tests is enough", slow=True),
    Rule(r"/data/scenes result_name=", "is written to", replace=(("/data/scenes", "DIR"),), slow=True),
    Rule(r"^(OMP\S+ )?cflow eval -m experiment=(?!.*data=)", "one small drive", add=SMALL_BENCHMARK, slow=True),
    Rule(r"experiment=(history|scales)(?!.*(data=|num_history))", "one h", add="model.num_history=0", slow=True),
    Rule(r"experiment=scales .*num_history=0,2,4,8", "two of four h", replace=(("0,2,4,8", "0,2"),), slow=True),
    Rule(
        r"experiment=scales .*data\.label=tuning",
        "one small drive",
        replace=(("data.num_drives=4", ""), ("data.num_sweeps=19", ""), ("data.first=8", "")),
    ),
    Rule(r"experiment=keypoints data=hdf5", "six settings", slow=True),
    Rule(r"experiment=(datasets|range_split).*data=(av2|hdf5)", "five scales in a region of +-70 m", slow=True),
    Rule(
        r"^cflow eval -m data=benchmark_sensors",
        "one drive of two sweeps of each sensor",
        add="data.num_drives=1 data.num_sweeps=2 data.first=0",
        slow=True,
    ),
    Rule(r"hydra/launcher=joblib", "an extra", needs="hydra_plugins.hydra_joblib_launcher"),
    Rule(r"hydra/launcher=submitit_local", "an extra", needs="hydra_plugins.hydra_submitit_launcher"),
    Rule(
        r"hydra/sweeper=optuna",
        "three trials; an extra",
        replace=(("n_trials=50", "n_trials=3"), ("range(0,5)", "range(0,2)")),
        needs="hydra_plugins.hydra_optuna_sweeper",
        slow=True,
    ),
    Rule(r"engine=ray", "starting a cluster takes seconds", add="engine.workers=1", needs="ray", slow=True),
    Rule(
        r"archive=results/cflow-e0-test-v3\.zip",
        "the archive is the harness's; one of our own stands for it",
        before=(
            f"{SUBMIT} data.root=simulated/test",
            "mkdir results",
            "cp outputs/submit/v3.zip results/cflow-e0-test-v3.zip",
        ),
    ),
    Rule(
        r"archive=mine\.zip",
        "somebody made it",
        before=(f"{SUBMIT} data.root=/data/challenge_public/test", "cp outputs/submit/v3.zip mine.zip"),
    ),
    Rule(r"beyond\.py targets .*300-303", "one seed", replace=(("300-303", "300-300"),), slow=True),
    Rule(r"beyond\.py targets .*300-307", "one seed", replace=(("300-307", "300-300"),), slow=True),
    Rule(r"beyond\.py score", "one seed", replace=(("100-103", "100-100"),), slow=True),
    Rule(r"--sets real odd sim sim0", "the real data may be absent", replace=(("real odd sim sim0", "sim0"),)),
    Rule(r"beyond\.py times", "one round", add="--rounds 1 --sets sim --seeds 300-300", slow=True),
    Rule(r"calibrate_confidence\.py evaluate CACHE", "one of four seeds", replace=((" 301 302 303", ""),), slow=True),
    Rule(r"paper\.py$", "20 windows instead of 200", add="data=benchmark_small"),
    Rule(r"paper\.py(?!.*data=av2)", "one small drive", add=SMALL_BENCHMARK),
    Rule(r"paper\.py", "one experiment of eight", add="--only views", slow=True),
    Rule(r"paper_tables\.py outputs/(paper|eval)", "of an earlier command", slow=True),
    Rule(r"paper_tables\.py outputs/paper", "results are there", before=(f"{PAPER_RESULTS} output=outputs/paper",)),
    Rule(r"paper_tables\.py outputs/eval", "results are there", before=(PAPER_RESULTS,)),
    Rule(
        r"bench_stages\.py",
        "of an earlier command",
        before=(f"{BENCH} output=outputs/av2", f"{BENCH} output=outputs/kitti"),
        slow=True,
    ),
    Rule(r"failure_cases\.py", "the pictures belong to the checkout", add="--pictures outputs/limits", slow=True),
    Rule(r"failure_cases\.py$", "one drive of five", add="--seeds 0"),
    Rule(r"config_reference\.py", "the page belongs to the checkout", add="--check"),
    Rule(r"bench_growth\.py", "one run of each", add="--repeats 1 --folder outputs/growth", slow=True),
    Rule(r"bench_keypoints\.py", "one run of each", add="--repeats 1", slow=True),
    Rule(r"bench_fleet\.py throughput", "one round", add="--repeats 1 --windows 40", slow=True),
    Rule(
        r"scripts/fuzz\.py.* --engine atheris",
        "atheris is no part of the tests",
        replace=((" --engine atheris", ""),),
        slow=True,
    ),
    Rule(r"scripts/fuzz\.py", "100 files", add="--engine hypothesis --cases 100"),
    Rule(r"leaks\.py", "60 windows", add="--windows 60", slow=True),
    Rule(r"bench_fleet\.py memory", "a tenth of the windows", add="--windows 200", slow=True),
    Rule(
        r"gpu_check\.py",
        "the rest repeats other tests",
        add="--skip tests speed memory",
        slow=True,
    ),
    Rule(r"keypoint_settings\.py", "two settings instead of the table", add="--grid patch_size=7,11", slow=True),
    Rule(r"ground_figures\.py", "all of it", slow=True),
    Rule(r"tests/test_(work|exactness_matrix|union_find_shapes)\.py|-m timeit", "all of it", slow=True),
    Rule(r"-m cflow_torch\.integrations", "imports torch anew", slow=True),
)

# Begin of commands -> why no test runs any of them. What is checked instead: the settings of cflow commands are
# composed, scripts are asked for help, shell is parsed; files, extras and models that are named exist.
KINDS_NOT_RUN: Dict[str, str] = {
    r"pip install ": "takes packages from the index",
    r"python3\.11 -m venv ": "a folder to install into",
    r"python (eval|save)\.py ": "the checkout of OpenSceneFlow is not here; tests/test_opensceneflow.py replays it",
    r"(\w+=\S+ )*(python -m )?pytest ": "that test is part of the suite",
    r"\./scripts/test\.sh": "runs this test",
    r"export ": "needs an object store",
}
# Exact command -> why no test runs it.
NOT_RUN: Dict[str, str] = {
    "OMP_NUM_THREADS=1 python scripts/bench_growth.py --repeats 5": "only repeats more than one that is run",
    "jupyter lab notebooks": "opens a browser; tests/test_notebooks.py runs every cell",
    "./scripts/demo.sh": "installs; .ci/run runs it on every commit",
    ".ci/run": "runs this test",
    "python /path/to/cflow_torch/tests/opensceneflow_stubs/launch.py eval.py ...": "needs files of OpenSceneFlow",
    "python scripts/lock.py": "asks PyPI; tests/test_lock.py holds what it wrote",
    "scripts/check_environments.py old": "makes environments: 6 GB from the index",
    "python scripts/check_environments.py old new": "makes environments: 12 GB from the index",
    "python scripts/beyond.py ablation --sets real odd sim --seeds 100-103": "hours; 15 minutes on one seed",
    "python scripts/calibrate_confidence.py fit CACHE": "replaces the package's own table",
    "python scripts/calibrate_confidence.py evaluate --real FOLDER": "needs both real data sets",
    "cflow eval -m experiment=scales hydra/launcher=submitit_slurm hydra.launcher.partition=cpu "
    "hydra.launcher.timeout_min=60": "submits to a SLURM cluster",
    "cflow flow -m hydra/launcher=submitit_slurm hydra.launcher.cpus_per_task=8 hydra.launcher.partition=cpu data=av2 "
    "data.root=/data/av2/train output=/scratch/flow shard.count=64 'shard.index=range(64)'": "submits to a cluster",
    "srun --ntasks=64 cflow flow ...": "runs within a SLURM job",
    "cflow flow engine=ray engine.address=auto engine.workers=64 ...": "needs a Ray cluster",
    "cflow flow engine=ray engine.address=auto ...": "needs a Ray cluster",
    "ray job submit -- cflow flow engine=ray engine.address=auto ...": "needs a Ray cluster",
}


def reason_not_run(text: str) -> str:
    """Why a command is not run; empty if it is."""
    kinds = (reason for pattern, reason in KINDS_NOT_RUN.items() if re.match(pattern, text))
    return NOT_RUN.get(text) or next(kinds, "")


def rules_of(text: str) -> Tuple[Rule, ...]:
    """Those that match a command."""
    return tuple(rule for rule in SHRUNK if re.search(rule.pattern, text))


# Python blocks, by document and first line: what they need beyond `documented_places.namespace`.
BLOCK_NEEDS: Dict[str, str] = {
    "from bucketed_scene_flow_eval.datasets import Argoverse2CausalSceneFlow": "bucketed_scene_flow_eval",
    "import runpy": "a checkout of SceneFlowZoo",
    "import h5py": "h5py",
    "from cflow_torch.data.hdf5 import write_hdf5_scene": "h5py",
}

# Documents whose Python blocks take more than ten seconds.
SLOW_BLOCKS = ("docs/harness.md",)
