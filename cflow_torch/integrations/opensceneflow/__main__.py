"""Write the checkpoint without weights that the scripts of OpenSceneFlow require."""

from __future__ import annotations

import argparse
import sys

from cflow_torch.integrations.opensceneflow.module import write_null_checkpoint
from cflow_torch.types import CFlowError


def main() -> None:
    """Run `python -m cflow_torch.integrations.opensceneflow`; an error exits with status 1 and one line on stderr."""
    parser = argparse.ArgumentParser("python -m cflow_torch.integrations.opensceneflow", description=__doc__)
    parser.add_argument("file", metavar="FILE", help="for example cflow.ckpt; its stem is the default name of results")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    arguments = parser.parse_args()
    try:
        print(f"wrote {write_null_checkpoint(arguments.file, overwrite=arguments.overwrite)}")
    except (CFlowError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
