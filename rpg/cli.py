"""What the Hydra entry points share: early checks of the command line, and errors in one line."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rpg.budget import within_budget
from rpg.conf import compose_config
from rpg.errors import RPGError, nearest

INTERRUPTED = 130  # exit code after Ctrl-C

_CONF = Path(__file__).parent / "conf"
_NOT_IN_FOLDER = (
    "agent",
    "env",
    "seed",
    "device",
    "compile",
    "threads",
    "logger",
    "trainer.steps",
    "trainer.checkpoint_every",
)

# Launchers of plugins, and ours that build on them: the plugin's own name, its package, and our extra.
_LAUNCHERS = {
    "joblib": ("joblib", "hydra-joblib-launcher", "joblib"),
    "slurm": ("submitit_slurm", "hydra-submitit-launcher", "slurm"),
    "submitit_slurm": ("submitit_slurm", "hydra-submitit-launcher", "slurm"),
    "submitit_local": ("submitit_local", "hydra-submitit-launcher", "slurm"),
    "ray": ("ray", "hydra-ray-launcher", "ray"),
    "ray_cluster": ("ray", "hydra-ray-launcher", "ray"),
}


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn an :class:`RPGError` into one line on stderr and exit code 2; Ctrl-C into exit code 130."""
    try:
        yield
    except RPGError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None


def is_sweep(args: list[str]) -> bool:
    """Whether these arguments ask for a sweep."""
    return bool({"-m", "--multirun"} & set(args))


def brings_configs(args: list[str]) -> bool:
    """Whether these arguments name configs other than ours."""
    flags = {"--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp"}
    return bool(flags & {a.split("=")[0] for a in args})


def in_sweep() -> bool:
    """Whether this code runs as a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN


def command_line() -> str:
    """The command that starts this run again, ready to be pasted; of a sweep, this run alone."""
    if in_sweep():
        return shlex.join(["rpg-train", *HydraConfig.get().overrides.task])
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def check_overrides(args: list[str], config: str = "config") -> None:
    """Check every ``key=value`` before Hydra starts, so that a typo costs nothing and explains itself.

    Args:
        args: of the command line.
        config: name of the command's config.

    Raises:
        RPGError: a malformed override, an unknown group option or an unknown key.
    """
    texts = [a for a in args if not a.startswith("-") and "=" in a]
    stray = [a for a in args if not a.startswith("-") and "=" not in a and not a.startswith("~")]
    if brings_configs(args) or {"--package", "-p", "--info"} & {a.split("=")[0] for a in args}:
        return  # the user brings configs of their own, or asks Hydra about itself
    if stray and "--cfg" not in args and "-c" not in args:
        raise RPGError(f"'{stray[0]}': overrides look like key=value, for instance agent=rpg")
    try:
        overrides = OverridesParser.create().parse_overrides(texts)
    except HydraException as error:
        raise RPGError(f"override: {str(error).strip().splitlines()[0]}") from error
    groups = {
        p.relative_to(_CONF).as_posix() for p in _CONF.rglob("*") if p.is_dir() and p.name != "__pycache__"
    } - {"hydra", "hydra/launcher"}
    for override in overrides:
        if override.key_or_group == "hydra/launcher":
            _check_launcher(str(_values(override)[0]), is_sweep(args))
    chosen = [o for o in overrides if o.key_or_group in groups]
    _check_options(chosen)
    sweeps = [text for override, text in zip(overrides, texts, strict=True) if override.is_sweep_override()]
    if sweeps and not is_sweep(args):
        raise RPGError(f"{sweeps[0]}: several values make a sweep; add -m, or quote a list as [a,b]")
    base = _compose([f"{o.key_or_group}={_values(o)[0]}" for o in chosen], config)
    for override in overrides:
        if override.key_or_group in groups or override.is_hydra_override():
            continue
        if not (override.is_add() or override.is_force_add()):
            _require_key(base, override.key_or_group, groups)
    single = [
        text for override, text in zip(overrides, texts, strict=True) if not override.is_sweep_override()
    ]
    removed = [a for a in args if a.startswith("~")]
    cfg = _compose([*single, *removed], config)
    if "budget" in cfg:  # of a figure's preset; a sweep would meet it too late to say so in one line
        within_budget(cfg.budget, 1, 1)
    # Hydra names the folder after the overrides of our keys, not after its own.
    named = ",".join(
        text
        for override, text in zip(overrides, texts, strict=True)
        if text.split("=")[0] not in _NOT_IN_FOLDER and not override.is_hydra_override()
    )
    if len(named) > 200 and not any(text.startswith("run_dir=") for text in texts):
        raise RPGError("too many overrides to name the run folder after them; add run_dir=runs/my_run")
    folder = OmegaConf.to_container(cfg, resolve=False)["run_dir"]  # type: ignore[call-overload,index]
    _require_folder(Path("runs" if folder is None or "${" in str(folder) else str(folder)))


def _check_options(chosen: list[Override]) -> None:
    """Refuse options that a config group does not have."""
    for override in chosen:
        options = [p.stem for p in (_CONF / override.key_or_group).glob("*.yaml")]
        for value in _values(override):
            if str(value) not in options:
                raise RPGError(f"{override.key_or_group}={value}: unknown; {nearest(str(value), options)}")


def _check_launcher(name: str, sweeps: bool) -> None:
    """Refuse a launcher that is unknown, whose plugin is missing, or that has no sweep to launch."""
    Plugins.instance()  # finds what is installed
    installed = {option.removesuffix(".yaml") for option in ConfigStore.instance().list("hydra/launcher")}
    known = installed | _LAUNCHERS.keys()
    if name not in known:
        raise RPGError(f"hydra/launcher={name}: unknown; {nearest(name, known)}")
    plugin, package, extra = _LAUNCHERS.get(name, (name, "", ""))
    if plugin not in installed:
        raise RPGError(
            f"hydra/launcher={name} needs the package '{package}': pip install -e '.[{extra}]' in a checkout, "
            f"or pip install {package}"
        )
    if not sweeps:
        raise RPGError(f"hydra/launcher={name}: launchers are for sweeps; add -m")
    if plugin == "submitit_slurm" and shutil.which("srun") is None:
        raise RPGError(
            f"hydra/launcher={name}: no Slurm here; submit from a machine that has 'srun', or try submitit_local"
        )


def _require_folder(path: Path) -> None:
    """Hydra makes the run folder before any code of ours runs, and would fail with a traceback."""
    existing = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise RPGError(
            f"run_dir={path}: cannot be made, {existing} is not a writable folder; choose another run_dir"
        )


def _values(override: Override) -> list[Any]:
    if override.is_sweep_override():
        return [str(v) for v in override.sweep_string_iterator()]
    value = override.value()
    return value if isinstance(value, list) else ["null" if value is None else value]


def _compose(overrides: list[str], config: str) -> DictConfig:
    try:
        return compose_config(*overrides, config=config)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise RPGError(f"config: {str(error).strip().splitlines()[0]}") from error


def _require_key(base: DictConfig, key: str, groups: set[str]) -> None:
    node: Any = base
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if not OmegaConf.is_dict(node):
            return
        if part not in node:
            if depth and parts[depth - 1] == "kwargs":
                raise RPGError(
                    f"{key}: constructor arguments of an environment are added with a plus: +{key}=..."
                )
            known = [str(k) for k in node] + (sorted(groups) if depth == 0 else [])
            where = ".".join(parts[:depth]) or "config"
            raise RPGError(f"{key}: no key '{part}' in {where}; {nearest(part, set(known))}")
        node = OmegaConf.to_container(node, resolve=False)[part]  # type: ignore[call-overload,index]
        node = OmegaConf.create(node) if isinstance(node, dict) else node
