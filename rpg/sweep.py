"""Sweeps: a job that fails leaves the others alone, and the command says in the end which did not finish.

A launcher may run a job in another process, on another machine, and kill it there. So what became of a run is
read from its folder.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException
from omegaconf import DictConfig, OmegaConf

from rpg.cli import INTERRUPTED, brings_configs, report_errors
from rpg.errors import RPGError
from rpg.training.loggers import write_atomic

OUTCOME = "outcome.json"

_log = logging.getLogger(__name__)


def note_outcome(folder: Path, env_steps: int | None = None, error: str | None = None) -> None:
    """Record how a run ended: complete at ``env_steps``, or by ``error``."""
    write_atomic(folder / OUTCOME, json.dumps({"env_steps": env_steps, "error": error}).encode())


def attempt(train: Callable[[DictConfig], dict[str, Any]], cfg: DictConfig) -> dict[str, Any]:
    """Run one job of a sweep. What makes it fail goes to its folder and its log, and the other jobs go on."""
    hydra = HydraConfig.get()
    os.chdir(hydra.runtime.cwd)  # a worker of Ray starts elsewhere
    if hydra.runtime.choices["hydra/launcher"] != "basic":
        os.environ["TERM"] = "dumb"  # runs that share a terminal print plain lines
    try:
        return train(cfg)
    except RPGError as error:
        message = str(error)
        _log.error(message)
    except Exception as error:  # noqa: BLE001 - logged with its traceback
        message = f"{type(error).__name__}: {error}; see train.log"
        _log.exception(message)
    with suppress(RPGError):
        note_outcome(Path(cfg.run_dir), error=message)
    raise CompactHydraException(f"{cfg.run_dir}: {message}")  # fails this job alone


def sweep(
    job: Callable[[], None], args: list[str], config: str = "config", length: str = "trainer.steps"
) -> None:
    """Let Hydra run the sweep that ``args`` ask for, then say what became of each run and exit.

    Args:
        job: the function that Hydra made, to be called without arguments.
        args: the command line.
        config: name of the command's config.
        length: its key that says how long a run is.
    """
    code: Any = 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # else joblib's workers would stay behind
    try:
        with report_errors():
            job()
    except SystemExit as end:
        code = end.code
    if code != INTERRUPTED and not brings_configs(args):
        with report_errors():
            _report(planned_runs(args, config, length))
    sys.exit(code)


def planned_runs(
    args: list[str], config: str = "config", length: str = "trainer.steps"
) -> list[tuple[Path, int]]:
    """Folder and last env step of every run of a sweep."""
    texts = [a for a in args if not a.startswith("-") and ("=" in a or a.startswith("~"))]
    parser = OverridesParser.create()
    runs = []
    with initialize_config_module("rpg.conf", version_base="1.3"):
        fixed = [o.input_line or "" for o in parser.parse_overrides(texts) if not o.is_sweep_override()]
        base = compose(config, overrides=fixed, return_hydra_config=True)
        # An experiment may bring a sweep of its own; what is typed replaces it key by key, as in Hydra.
        own = [f"{key}={values}" for key, values in (base.hydra.sweeper.params or {}).items()]
        choices: dict[str, list[str]] = {}
        for override in parser.parse_overrides([*own, *texts]):
            key = override.get_key_element()
            values = (
                [f"{key}={value}" for value in override.sweep_string_iterator()]
                if override.is_sweep_override()
                else [override.input_line or ""]
            )
            choices[key] = values
        for chosen in itertools.product(*choices.values()):
            cfg = compose(config, overrides=list(chosen), return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)  # run_dir has the folder's name from there
            runs.append((Path(cfg.run_dir), int(OmegaConf.select(cfg, length))))
    return runs


def _report(runs: list[tuple[Path, int]]) -> None:
    missing = 0
    for folder, steps in runs:
        path = folder / OUTCOME
        outcome = json.loads(path.read_text()) if path.exists() else {"env_steps": None, "error": None}
        if (outcome["env_steps"] or 0) < steps:
            missing += 1
            print(f"{folder}: {outcome['error'] or 'not finished'}")
    if missing:
        raise RPGError(f"{missing} of {len(runs)} runs did not finish; the same command goes on with them")
    print(f"all {len(runs)} runs finished")
