"""The process that is fuzzed: python -m fuzzing.child TARGET ENGINE CASES SEED LEDGER WORK."""

from __future__ import annotations

import os
import resource
import sys
import warnings
from pathlib import Path
from typing import Callable

from fuzzing.ledger import Ledger
from fuzzing.outcome import outcome
from fuzzing.target import Target

SPACE = 6 << 30  # bytes of address space beyond those at the start: what asks for more gets a MemoryError
GROWTH = 2 << 30  # bytes of real memory that no file may cost; the readers' own bound is 1 GiB an array


def main() -> None:
    name, engine, cases, seed, ledger_folder, work = sys.argv[1:]
    from fuzzing.targets import TARGETS

    target, ledger, folder = TARGETS[name], Ledger(Path(ledger_folder)), Path(work)
    target.prepare(folder)
    for whole in target.seeds():
        outcome(target, folder, whole)  # imports and caches are no growth
    warnings.simplefilter("ignore")
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + SPACE, size + SPACE))
    one = _one_case(target, ledger, folder)
    {"hypothesis": _hypothesis, "atheris": _atheris}[engine](target, one, int(cases), int(seed), folder)


def _one_case(target: Target, ledger: Ledger, folder: Path) -> Callable[[bytes], None]:
    before = last = _peak()

    def one(data: bytes) -> None:
        nonlocal last
        ledger.add("cases")
        try:
            ledger.add(outcome(target, folder, data))
        except Exception as error:
            ledger.exception(error, data)
        peak = _peak()
        if peak > last:
            ledger.grown(peak - before)
            if peak - last > GROWTH:
                ledger.finding("memory", data, f"{peak - last} bytes\n")
            last = peak

    return one


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _hypothesis(target: Target, one: Callable[[bytes], None], cases: int, seed: int, folder: Path) -> None:
    import hypothesis

    left = cases
    while left > 0:  # hypothesis leaves out what it has tried, and may end early

        @hypothesis.seed(seed)
        @hypothesis.settings(
            max_examples=min(left, 10000),
            database=None,
            deadline=None,
            phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )
        @hypothesis.given(target.cases())
        def every_case(data: bytes) -> None:
            nonlocal left
            left -= 1
            one(data)

        every_case()
        seed += 1


def _atheris(target: Target, one: Callable[[bytes], None], cases: int, seed: int, folder: Path) -> None:
    import atheris

    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for number, whole in enumerate(target.seeds()):
        (corpus / str(number)).write_bytes(whole)
    tokens = folder / "tokens"
    lines = ("".join(f"\\x{byte:02x}" for byte in token) for token in target.tokens if token)
    tokens.write_text("".join(f'"{line}"\n' for line in lines))
    options = [f"-runs={cases}", f"-seed={seed + 1}", "-max_len=65536", "-len_control=0", "-verbosity=0"]
    options += ["-rss_limit_mb=0", "-timeout=600", "-detect_leaks=0", *([f"-dict={tokens}"] if target.tokens else [])]
    atheris.Setup(["fuzz", *options, str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    if sys.argv[2] == "atheris":
        import atheris

        os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")
        with atheris.instrument_imports(include=["cflow_torch"]):
            import fuzzing.targets  # noqa: F401  the readers, watched branch by branch
    main()
