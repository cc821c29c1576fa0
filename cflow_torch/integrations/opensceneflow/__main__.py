"""python -m cflow_torch.integrations.opensceneflow FILE: write the checkpoint without weights."""

from cflow_torch.integrations.opensceneflow.checkpoint import main

if __name__ == "__main__":
    main()
