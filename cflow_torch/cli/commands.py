"""The commands of `cflow`: their settings with default, meaning and bounds, and their help.

Hydra composes the settings, and the function `task` of the module cflow_torch.cli.<command> gets them. We import
neither torch nor Hydra here, so that help costs little.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from cflow_torch.config import Config
from cflow_torch.setting import AUTO, Settings, bounds, checked, setting

NOT_GIVEN = "???"  # a setting without a value
PAIR_SETTINGS = ("data.first", "data.step")

# Settings of data sets that we check before a reader gets them. configs/data/ has the defaults of all of them.
DATA_SETTINGS: dict[str, dict[str, Any]] = {
    **dict.fromkeys(("first", "seed", "first_seed"), bounds(int, low=0)),
    **dict.fromkeys(("step", "num_sweeps", "num_drives", "sweep_step"), bounds(int, low=1)),
    "both_returns": bounds(bool),
    "check": bounds(bool, free=True),
    "cache": bounds(str, free=True),
}


def group(default: str | None, help: str = "", kind: type | None = None) -> Any:
    """Make a field whose value is one of several groups of settings, such as `model=paper`; by default `default`.

    `kind` is the class of the settings, if they have one.
    """
    return field(default=default, metadata={"group": True, "help": help, **({} if kind is None else bounds(kind))})


def _output(default: str, help: str) -> Any:
    return setting(default, help, free=True)


def _overwrite(help: str) -> Any:
    return setting(False, help, free=True)


def _device(free: bool = False) -> Any:
    return setting(AUTO, "auto | cpu | cuda | cuda:1", free=free)


def _above_0(default: float | None, help: str, **limits: Any) -> Any:
    return setting(default, help, kind=float, above=0, high=1e12, **limits)


def _count(default: int | None, help: str, **limits: Any) -> Any:
    return setting(default, help, kind=int, low=1, **limits)


def _number(help: str, low: int = 1, high: float = 100_000) -> Any:  # more is a typing error
    return setting(AUTO, help, kind=int, low=low, high=high, word=AUTO)


def _share(help: str) -> Any:
    return setting(AUTO, help, kind=float, low=0, high=1e6, word=AUTO)


def _path(help: str, free: bool = False) -> Any:
    return setting(None, help, kind=str, free=free)


@dataclass(frozen=True)
class ShardSettings(Settings):
    PREFIX: ClassVar[str] = "shard."

    index: int | str = _number(
        "index of this process, from 0; auto = of SLURM or torchrun, else the only one", 0, 2**53
    )
    count: int | str = _number("number of processes that share the work; auto = as index", 1, 2**53)


@dataclass(frozen=True)
class Engine(Settings):
    """Settings of what runs the workers."""

    PREFIX: ClassVar[str] = "engine."
    NAMED_BY: ClassVar[str] = "name"

    name: str = setting("", "the engine; engine= chooses it")
    workers: int | str = _number("processes; auto = one per core of a CPU, with one thread each, or one per GPU")
    batch: int | str = _number("number of windows that are computed together")

    @classmethod
    def kinds(cls) -> dict[str, type[Engine]]:
        return ENGINES


@dataclass(frozen=True)
class Local(Engine):
    """Worker processes of this machine."""

    name: str = setting("local", "the engine; engine= chooses it", choices=("local",))
    timeout: float = _above_0(
        600, "seconds without a finished batch after which a worker is replaced (with several workers)"
    )
    memory: float | None = _above_0(
        None, "limit of the address space of each worker on a CPU, in bytes, such as 8e9; null = none; not on Windows"
    )


@dataclass(frozen=True)
class Ray(Engine):
    """Ray actors on one machine or on a cluster (extra ray)."""

    name: str = setting("ray", "the engine; engine= chooses it", choices=("ray",))
    workers: int | str = _number("actors; auto = the cores or GPUs of this machine; with an address, give a number")
    address: str | None = _path("null = start a cluster in this process, and end it; auto or HOST:PORT = join one")
    num_cpus: float | str = _share("CPUs that each worker takes from the cluster; auto = 1 without a GPU, 0 with one")
    num_gpus: float | str = _share(
        "GPUs that each worker takes, 0.5 = two workers share one; auto = 1 if device is cuda"
    )


ENGINES: dict[str, type[Engine]] = {"local": Local, "ray": Ray}


class WordCommand:
    """A command that takes words instead of settings."""

    SUMMARY: ClassVar[str]


@dataclass(frozen=True)
class Command(Settings):
    """A command with settings."""

    SUMMARY: ClassVar[str]
    CHOOSES_PAIRS: ClassVar[bool] = False  # the command uses `PAIR_SETTINGS`

    output: str = _output("outputs", "folder of the results")
    model: Config = group("default", kind=Config)
    data: dict[str, Any] = group(AUTO)  # settings of the data set

    def check(self) -> None:
        for name, value in self.data.items():
            if name in DATA_SETTINGS and value != NOT_GIVEN:
                checked(f"data.{name}", value, DATA_SETTINGS[name])

    @classmethod
    def groups(cls) -> dict[str, str | None]:
        """Return the default choice of each group."""
        return {f.name: getattr(cls, f.name) for f in fields(cls) if "group" in f.metadata}


@dataclass(frozen=True)
class Demo(Command):
    """Simulates a drive, estimates its flow, scores it and draws it. You need no data.

    The drive is written in Argoverse 2's format to outputs/cache and read from there like a real log. OUTPUT
    (outputs/demo) contains flow.html (a 3-D page for any browser), flow.png, <log id>/ with one flow file per pair,
    results.json with the scores, and config.yaml with the settings. Of several logs, page and picture show the first.

    examples:
      cflow demo
      cflow demo data.seed=7 pair=2 output=outputs/another    another street, another pair in the picture
      cflow demo model=paper                                  the method of the paper
    """

    SUMMARY: ClassVar[str] = "simulate a drive, estimate its flow, score it and draw it"

    output: str = _output("outputs/demo", "folder of flow, scores, picture and settings")
    device: str = _device()
    definition: str = setting("opensceneflow", "definition of the scores, see `cflow eval --help`")
    pair: int = setting(3, "index of the pair that is drawn", low=0)
    data: dict[str, Any] = group("synthetic")


@dataclass(frozen=True)
class Check(Command):
    """Says for each log what is right, what was found and is used, and what is wrong and how to fix it. Writes nothing.

    A page has a line each for sensor, frame, times, poses, ego motion, de-skewing, ground, own vehicle and labels. The
    ego motion is judged by one question: under which reading of the poses does the static world stand still? If another
    reading than yours is clearly better, the line names the setting that chooses it. The exit status is 1 if a line is
    wrong. The other commands make the quick part of this check, and print only what is not right.

    examples:
      cflow check /data/my_drive                      recognises the format
      cflow check /data/a /data/b.bag                 several paths
      cflow check /data/my_drive json=true            the same as JSON: a list of logs for each path
      cflow check /data/my_drive data.read_as=inverted   try what the check proposes
    """

    SUMMARY: ClassVar[str] = "say what is right and what is wrong in your data, and how to fix it"

    output: str = _output("outputs/check", "unused, nothing is written")
    json: bool = setting(False, "true = print JSON")


@dataclass(frozen=True)
class FlowFiles(Command):
    """Settings of the commands that write flow files."""

    device: str = _device()
    overwrite: bool = _overwrite("true = compute these logs again and replace their older results")
    dry_run: bool = setting(False, "true = only count the frames of each log, and those left to do")
    shard: ShardSettings = setting(ShardSettings(), "share of the work for this process", kind=ShardSettings)
    engine: Engine = group("local", kind=Engine)


@dataclass(frozen=True)
class Flow(FlowFiles):
    """Estimates the flow of every pair of sweeps: OUTPUT/<log id>/<time stamp of sweep t>.feather.

    Each file has one row per point of sweep t. Columns: flow_t{x,y,z}_m total flow, residual_t{x,y,z}_m motion of
    objects, pose_t{x,y,z}_m ego motion (float32, metres per sweep, axes of the ego frame at t+1), cluster_id, score,
    is_valid. There are also the columns confidence and moving, unless model=paper or keypoints. docs/applications.md
    describes the files of tracks=, labels= and masks=.

    OUTPUT/config.yaml contains settings and versions; OUTPUT/reports has the report. Run the command again to resume.
    Results of other logs in OUTPUT stay. After Ctrl-C, SIGTERM or SIGHUP the run finishes the frames that it has begun.
    The exit status is 0 if every frame is complete, 1 if one is missing, 2 if the call was wrong, and 128 + n after
    signal number n.

    examples:
      cflow flow data=av2 data.root=/data/av2/val output=outputs/val
      cflow flow /data/drive_1 /data/drive_2                          several paths of one format
      cflow flow data=av2 data.root=/data/av2/val dry_run=true        counts the frames
      cflow flow model=paper model.pixel_sizes=[0.2] engine.workers=8
      cflow flow /data/drive contents=[residual,is_valid]             much smaller files
      cflow flow shard.index=2 shard.count=16 ...                     one of 16 processes, on any machine
      cflow flow engine=ray engine.address=auto ...                   on a Ray cluster
      cflow flow data=av2 data.root=s3://bucket/val output=s3://bucket/flow
      cflow flow data=hdf5 data.root=/data/scenes result_name=cflow
      cflow flow /data/drive tracks=true
    """

    SUMMARY: ClassVar[str] = "estimate the flow of every pair of sweeps: resumable, parallel, on many machines"

    output: str = _output("outputs/flow", "folder, or address in an object store")
    contents: Any = setting(
        AUTO,
        "columns of each file, such as [points, residual, is_valid]; auto = all but points (x, y, z of sweep t)",
        several=True,
    )
    result_name: str | None = _path(
        "key under which HDF5 scenes also get the total flow, as OpenSceneFlow's viewers read it"
    )
    tracks: bool | str = setting(
        False,
        "true = also write the moving objects of each complete log to <log id>/tracks.parquet; mot, kitti, "
        "drivestudio, nuscenes, openpcdet = and in this format",
        kind=object,
        choices=(True, False, "mot", "kitti", "drivestudio", "nuscenes", "openpcdet"),
    )
    labels: str | None = setting(
        None,
        "semantickitti = also write the moving points of each complete log to sequences/<log id>/predictions",
        kind=str,
        choices=(None, "semantickitti"),
    )
    masks: bool = setting(
        False,
        "true = also write masks of dynamic objects for the calibrated cameras of each complete log, and its tracks; "
        "with tracks=drivestudio, those that DriveStudio reads",
    )


@dataclass(frozen=True)
class Label(FlowFiles):
    """Labels HDF5 scenes for the training of SeFlow, SeFlow++ and TeFlow, without annotations.

    Each sweep gets the keys dufo (dynamic), dufocluster, cluster and nnd. It gets ground_mask if it has none. Types and
    meanings are those of OpenSceneFlow's own scripts. First, the command estimates the flow like `cflow flow`, with the
    preset offline, which uses earlier and later sweeps. Then each scene is copied, labelled and replaced, so a killed
    run leaves the old scene or the new one. Run the command again to resume, also with overwrite=true: scenes that have
    the labels of these settings are skipped, and need no flow. So you can delete OUTPUT when all scenes are labelled.
    The report, cflow_label-0-of-1.json, is next to the scenes. With shards, the process that completes the flow of a
    scene labels it. The exit statuses are those of `cflow flow`.

    examples:
      cflow label /data/scenes/train
      cflow label /data/scenes/train dry_run=true                 counts the frames
      cflow label /data/scenes/train model=default                half the time, finds fewer people
      cflow label /data/scenes/train shard.index=2 shard.count=16
    """

    SUMMARY: ClassVar[str] = "write pseudo-labels for self-supervised training into OpenSceneFlow's scenes"

    output: str = _output("outputs/label", "folder for the flow that the labels follow from")
    overwrite: bool = _overwrite("true = replace labels of other settings or programs, and flow of other settings")
    model: Config = group("offline", kind=Config)
    data: dict[str, Any] = group("hdf5")


@dataclass(frozen=True)
class Eval(Command):
    """Estimates and scores all labelled pairs: tables on the screen, OUTPUT/results.json and OUTPUT/config.yaml.

    A run whose results exist for the same settings, versions and logs is not repeated, its tables are printed;
    overwrite=true repeats it, for example with new labels. Each job of a sweep (-m) writes to a folder below OUTPUT
    that is named after its swept settings. At the end of the sweep, a table compares all jobs in OUTPUT; it is also
    written to OUTPUT/comparison.csv. A sweeper minimises the mean dynamic error; of definition=av2 the three-way
    end-point error, of definition=mos 1 - IoU.

    examples:
      cflow eval data=av2 data.root=/data/av2/val model=paper
      cflow eval data=hdf5 data.root=/data/scenes model.num_history=2     fewer sweeps: faster
      cflow eval definition=av2                    scores as another public evaluator defines them
      cflow eval /data/kitti/sequences/08 definition=mos    IoU of moving points, by the classes of SemanticKITTI
      cflow eval -m model.num_history=0,2,4        a sweep: outputs/eval/model.num_history=2/results.json, ...
      cflow eval -m experiment=pixel_size          a table or figure of the paper, see docs/settings.md
    """

    SUMMARY: ClassVar[str] = "estimate and score all labelled pairs of a data set"
    CHOOSES_PAIRS: ClassVar[bool] = True

    output: str = _output("outputs/eval", "folder of the results; each job of a sweep writes to a folder below it")
    overwrite: bool = _overwrite("true = repeat a run whose results.json exists")
    device: str = _device()
    definition: str = setting(
        "opensceneflow",
        "of the scores: opensceneflow | bucketed_scene_flow_eval | av2 | challenge_2026 | challenge_2026_box | mos",
    )
    experiment_name: str | None = setting("${hydra:runtime.choices.experiment}", "name in results.json", optional=True)
    row: str | None = group(None, "row of an experiment whose rows differ in more than one setting")
    experiment: str | None = group(None)


@dataclass(frozen=True)
class Submit(Command):
    """Writes the archive for a public leaderboard: OUTPUT/v<version>.zip, from the files in OUTPUT/v<version>/.

    The archive is checked and stays only if it passes. Run the command again to resume. OUTPUT/config.yaml contains the
    settings and versions.

    version=1: Argoverse 2 scene flow 2023, total flow of the points of the evaluation masks.
    version=3: the multi-dataset challenge of 2026, residual flow of all points.

    examples:
      cflow submit data=hdf5 data.root=/data/challenge_public/test version=3
      cflow submit data=av2 data.root=/data/av2/test version=1 masks=/data/av2/test-masks.zip
      cflow submit data=hdf5 data.root=/data/challenge_public/test version=3 archive=mine.zip    only checks
    """

    SUMMARY: ClassVar[str] = "write and check an archive for a public leaderboard"

    output: str = _output("outputs/submit", "folder of the files and the archive")
    device: str = _device(free=True)
    version: int = setting(3, "of the leaderboard: 1 (Argoverse 2, 2023) | 3 (multi-dataset challenge, 2026)")
    archive: str | None = _path("zip or folder that is only checked against the data", free=True)
    frames: str | None = _path("text file of frames, one <log>/<time stamp> per line; null = see docs/evaluation.md")
    masks: str | None = _path(
        "zip of the official masks, for version 1; null = eval_mask of the scenes, else the official rule"
    )
    overwrite: bool = _overwrite("true = delete the files of an earlier run in output")


@dataclass(frozen=True)
class Plot(Command):
    """Draws one pair of sweeps, or an animation of a log: OUTPUT/<picture>.png (animation: .gif or .mp4).

    log=ID and pair=N choose the pair. Without log=, the first log is drawn.

    examples:
      cflow plot                                             the simulated street, outputs/plot/flow.png
      cflow plot picture=correlation pair=2
      cflow plot picture=scales model.pixel_sizes=[0.8,0.4,0.2,0.1]
      cflow plot data=av2 data.root=/data/av2/val/LOG pair=2 truth=true
      cflow plot picture=animation count=5 model.num_history=0
    """

    SUMMARY: ClassVar[str] = "draw flow, clusters, key points, correlation, scales or an animation"
    NAMED_BY: ClassVar[str] = "picture"
    PRESET: ClassVar[str] = ""  # that the picture chooses, "" = none
    PIXEL_SIZES: ClassVar[tuple[float, ...]] = ()  # that the picture chooses

    output: str = _output("outputs/plot", "local folder; the file is named after the picture")
    device: str = _device()
    log: str | None = _path("id of the log; null = the first one")
    pair: int | None = setting(
        None,
        "index of the pair in the log, from 0; null = the fourth pair, or the last one of a shorter log",
        kind=int,
        low=0,
    )
    picture: str = group("flow")

    @classmethod
    def kinds(cls) -> dict[str, type[Plot]]:
        return PICTURES


@dataclass(frozen=True)
class FromAbove(Plot):
    """The points of sweep t from above."""

    deskew: bool = setting(
        False, "true = draw moving objects where they were at the time of the sweep (by point times)"
    )


@dataclass(frozen=True)
class FlowPicture(FromAbove):
    """The flow from above. If the log has labels, the truth and the error are drawn next to it."""

    truth: bool | str = setting(
        AUTO, "true | false | auto = if the log has labels", kind=object, choices=(True, False, AUTO)
    )
    max_flow: float | None = _above_0(None, "m per sweep at the rim of the colour wheel; null = the longest flow")


@dataclass(frozen=True)
class ClustersPicture(FromAbove):
    """The points of sweep t coloured by cluster.

    With model=paper those that are correlated, with model=default those that were selected.
    """

    PRESET: ClassVar[str] = "paper"


@dataclass(frozen=True)
class KeypointsPicture(Plot):
    """The pixels of both sweeps, their key points and the matches."""

    PRESET: ClassVar[str] = "keypoints"


@dataclass(frozen=True)
class CorrelationPicture(Plot):
    """One cluster: its template, its target, and the correlation of all shifts as an image and as a surface."""

    PRESET: ClassVar[str] = "paper"

    cluster: int | None = setting(
        None,
        "cluster_id as in flow files; null = the one whose number of points times length of flow is largest",
        kind=int,
    )


@dataclass(frozen=True)
class ScalesPicture(CorrelationPicture):
    """One cluster and the flow, coarse to fine: one column per pixel size and one more."""

    PIXEL_SIZES: ClassVar[tuple[float, ...]] = (0.4, 0.2, 0.1)


@dataclass(frozen=True)
class Animation(Plot):
    """The flow of several pairs, one after the other, with the same view and colours. `pair` is ignored."""

    CHOOSES_PAIRS: ClassVar[bool] = True

    count: int | None = _count(None, "number of pairs, from data.first, every data.step; null = to the end of the log")
    format: str = setting("gif", "gif | mp4 (extra video)", choices=("gif", "mp4"))
    frames_per_second: float = _above_0(5.0, "pictures per second")
    width: int = _count(800, "pixels")
    max_flow: float | None = _above_0(
        None, "m per sweep at the rim of the colour wheel; null = the longest flow of all frames"
    )
    legend: str = setting("upper right", "corner of the colour wheel: upper right | lower right | upper left")


PICTURES: dict[str, type[Plot]] = {
    "animation": Animation,
    "clusters": ClustersPicture,
    "correlation": CorrelationPicture,
    "flow": FlowPicture,
    "keypoints": KeypointsPicture,
    "scales": ScalesPicture,
}


@dataclass(frozen=True)
class View(Command):
    """Writes a 3-D page per log, OUTPUT/<log id>.html, that any browser opens without a network.

    The extra `html` makes pages. A page has a timeline of sweeps. It shows the points of sweep t, coloured by residual
    flow, speed, object, confidence, P(moving) and, if the log has labels, truth or error. It also shows an arrow per
    moving cluster, and the boxes, trails, ids and speeds of tracks. Click on an object for more. A recording has all
    points and sweep t+1 (extra `rerun`).

    examples:
      cflow view                                                   a simulated street, no data needed
      cflow view /data/av2/val/LOG                                 one log
      cflow view data=hdf5 data.root=/data/scenes count=20         the first 20 pairs of each scene
      cflow view data.first=2 data.step=2 max_flow=0.5             every second pair; full colour at 0.5 m per sweep
      cflow view flow=outputs/flow format=rerun                    the output of `cflow flow` of the same data
    """

    SUMMARY: ClassVar[str] = "write a 3-D page for the browser, or a recording for the viewer rerun"
    CHOOSES_PAIRS: ClassVar[bool] = True

    output: str = _output("outputs/view", "local folder; each log gets <log id>.html or .rrd")
    format: str = setting(
        "html", "html = a page for any browser | rerun = a recording for the viewer rerun", choices=("html", "rerun")
    )
    device: str = _device()
    flow: str | None = _path("output folder of `cflow flow` whose flow is shown; null = estimate the flow")
    count: int | None = _count(None, "number of pairs of each log, from data.first, every data.step; null = all")
    max_flow: float = _above_0(1.5, "motion with the full colour, in metres per sweep; the same for all logs")
    voxel: float = _above_0(
        0.1, "a page keeps one static point per cube of this side, metres; for ground twice the side"
    )
    show: bool = setting(False, "true = open the files at the end")


@dataclass(frozen=True)
class Stream(Command):
    """Replays the first log of the data in real time and measures the latency: a summary and OUTPUT/stream.json.

    Latency is the time from the arrival of sweep t+1 to the flow of sweep t. A late result delays the next one. If
    sweeps have no poses, generalised ICP (extra odometry) estimates them, and the latency includes this time.

    examples:
      cflow stream drive.bag                          at the speed of the recording
      cflow stream /data/av2/val/LOG pace=null        as fast as possible
      cflow stream drive.bag model=live device=cuda
    """

    SUMMARY: ClassVar[str] = "replay a log in real time and measure the latency"

    output: str = _output("outputs/stream", "folder of stream.json")
    device: str = _device()
    pace: float | None = _above_0(
        1.0, "factor on the speed of the recording; null = as fast as possible", optional=True
    )
    max_gap: float = setting(0.5, "seconds; sweeps with a longer gap between them are not compared")
    count: int | None = setting(None, "number of sweeps; null = all", kind=int, low=2)


@dataclass(frozen=True)
class Clean(Command):
    """Writes logs without dynamic objects: OUTPUT/<log id>, a folder of point clouds, poses, times and ground masks.

    data=arrays reads such a folder. A point is dynamic if its flow is at least 0.05 m per sweep. With the presets
    default, offline and live, its P(moving) must also be at least 0.5. Clouds of a folder keep their names, columns and
    types, and poses in VIEWPOINT; those of other data sets have the numbers of their sweeps. We also keep the other
    columns of bags, Argoverse 2 and PandaSet, such as intensity. removed/NAME.npy has a bool per point of a sweep, True
    = not in the clean cloud, and clean.json the settings. All files of a log are in its folder, which is written as a
    whole or not at all. Run the command again to write the missing logs. Other files in OUTPUT stay.

    examples:
      cflow clean /data/drive map=true voxel_size=0.2            any recognised format, such as a bag
      cflow clean data=av2 data.root=/data/av2/val remove_stopped=true
      cflow clean /data/drive flow=outputs/flow                  with the output of `cflow flow`
    """

    SUMMARY: ClassVar[str] = "remove dynamic objects from logs, and build static maps"

    output: str = _output("outputs/clean", "local folder; each log gets <log id>/points, poses.txt, ...")
    model: Config = group("offline", kind=Config)
    device: str = _device(free=True)
    overwrite: bool = _overwrite("true = write these logs again and replace their older results")
    flow: str | None = _path("output folder of `cflow flow` whose flow is used; null = estimate the flow")
    remove_stopped: bool = setting(False, "also remove objects that move at another time, such as a waiting car")
    suffix: str | None = _path(
        "format of the clouds: .npy | .ply | .pcd | .bin | ...; null = that of the log's own clouds, else .npy"
    )
    map: bool = setting(
        False, "also write the static points in the world, one per voxel, to <log id>/map.ply, and a picture", free=True
    )
    voxel_size: float = _above_0(0.1, "side of a voxel of the map, in metres", free=True)


@dataclass(frozen=True)
class Bench(Command):
    """Measures the run time of the method and of its stages, windows per second, and memory.

    It prints a table and writes OUTPUT/bench.json. The pairs are spread evenly over the first log and run one at a time
    and in batches. Times start with the points in memory and end with the flow on the device. Other work on the machine
    distorts them.

    examples:
      cflow bench                                                    a simulated street
      cflow bench data=av2 data.root=/data/av2/val/LOG repeats=50    real data, more runs
      cflow bench model=paper 'batches=[1,8]'                        another method
    """

    SUMMARY: ClassVar[str] = "measure run time and memory on your data"

    output: str = _output("outputs/bench", "folder of bench.json")
    device: str = _device()
    pairs: int = _count(3, "number of pairs, spread evenly over the first log")
    repeats: int = _count(10, "timed runs of each pair and of each batch")
    batches: tuple[int, ...] = setting(
        (1, 8), "batch sizes for which windows per second are measured", kind=int, low=1, several=True
    )


class ListSettings(WordCommand):
    """Prints all settings as a Markdown page: of the methods, then of the commands, data sets and other groups.

    With names, it prints only these: a setting, a preset, a command, a group or one of its choices.

    examples:
      cflow settings max_speed          default, allowed values and meaning of a setting
      cflow settings data.find_ground   a setting of several data sets
      cflow settings data               the choices of a group
      cflow settings data=hdf5 eval     all settings of a data set and of a command
      cflow settings > settings.md
    """

    SUMMARY: ClassVar[str] = "list all settings with defaults and explanations"


class Info(WordCommand):
    """Prints the versions of cflow_torch and of the packages that it uses, the system, the processor and the GPUs.

    The last line names the optional packages that are not installed. If the bug is one of a GPU, please add the output
    of `python -m torch.utils.collect_env`.

    examples:
      cflow info            paste the output into a bug report
      cflow --version       prints the version only
    """

    SUMMARY: ClassVar[str] = "print the versions and the environment for a bug report"


# In the order of the help. The key is also the module of the command.
COMMANDS: dict[str, type[Command] | type[WordCommand]] = {
    "demo": Demo,
    "check": Check,
    "flow": Flow,
    "label": Label,
    "eval": Eval,
    "submit": Submit,
    "plot": Plot,
    "view": View,
    "stream": Stream,
    "clean": Clean,
    "bench": Bench,
    "settings": ListSettings,
    "info": Info,
}
WITH_SETTINGS: dict[str, type[Command]] = {name: kind for name, kind in COMMANDS.items() if issubclass(kind, Command)}


def own_fields(kind: type[Settings]) -> list[Any]:
    """Return the settings of a class that are not groups."""
    return [f for f in fields(kind) if "kind" in f.metadata and "group" not in f.metadata]  # type: ignore[arg-type]
