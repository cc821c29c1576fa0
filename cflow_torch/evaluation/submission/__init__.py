"""Archives for the public leaderboards, versions 1, 2 and 3: written, packed and checked."""

from cflow_torch.evaluation.submission.check import check_submission
from cflow_torch.evaluation.submission.encode import encode
from cflow_torch.evaluation.submission.plan import Frame, plan_log
from cflow_torch.evaluation.submission.versions import SubmissionVersion, get_version
from cflow_torch.evaluation.submission.write import is_complete, pack, write_frame, write_metadata

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
    "write_metadata",
]
