"""Archives for the public leaderboards, versions 1 and 3: written, packed and checked."""

from cflow_torch.evaluation.submission.archive import check_submission, is_complete, pack, write_frame
from cflow_torch.evaluation.submission.formats import SubmissionVersion, encode, get_version
from cflow_torch.evaluation.submission.frames import Frame, plan_log

__all__ = [
    "Frame",
    "SubmissionVersion",
    "check_submission",
    "encode",
    "get_version",
    "is_complete",
    "pack",
    "plan_log",
    "write_frame",
]
