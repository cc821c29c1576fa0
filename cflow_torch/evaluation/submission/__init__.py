"""Archives for the public leaderboards, versions 1, 2 and 3: written, packed and checked."""

from cflow_torch.evaluation.submission.archive import pack
from cflow_torch.evaluation.submission.check import check_submission
from cflow_torch.evaluation.submission.encode import Rounding, encode
from cflow_torch.evaluation.submission.plan import Frame, PlannedFrame, plan_log
from cflow_torch.evaluation.submission.versions import VERSIONS, SubmissionVersion, get_version
from cflow_torch.evaluation.submission.write import is_complete, write_frame, write_metadata

__all__ = [
    "VERSIONS",
    "Frame",
    "PlannedFrame",
    "Rounding",
    "SubmissionVersion",
    "check_submission",
    "encode",
    "get_version",
    "is_complete",
    "pack",
    "plan_log",
    "write_frame",
    "write_metadata",
]
