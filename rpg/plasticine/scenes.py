"""Scenes as data: a YAML file of bodies, tools and constants, checked against dataclasses (thesis 2.3.1, 2.6.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from rpg.errors import RPGError, nearest

# Numbers that a preset changes against the defaults of `SceneConfig`.
PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": {},  # and fewer substeps
    "exact": {"dtype": "float64"},
}

# Of an environment step's substeps; the step stays as long as it is. 14 in place of 19, three quarters of the time.
FAST_SUBSTEPS = 0.74

# Sweeps of the eigenproblem that its adjoint needs to be as good as the dtype.
SWEEPS = {"float32": 3, "float64": 6}

BODY_SHAPES: dict[str, tuple[str, ...]] = {"box": ("edge_x", "edge_y", "edge_z"), "ball": ("radius",)}

# Degrees of freedom of each kind of motion, in the order of a tool's ``scale``.
MOTIONS: dict[str, tuple[str, ...]] = {
    "fixed": (),
    "translate": ("x", "y", "z"),
    "pose": ("x", "y", "z", "turn_x", "turn_y", "turn_z"),  # turns about the axes of the world
    "roll": ("roll", "yaw", "height"),
    "chopsticks": ("x", "y", "z", "turn_x", "turn_y", "turn_z", "close"),  # turns about the tool's own axes
}


@dataclass
class BodyConfig:
    """A piece of plasticine at rest, filled with particles at random.

    Attributes:
        shape: box or ball.
        size: full edges of a box, radius of a ball; the domain's edge is 1.
        centre: where its middle is; y is up.
        particles: how many.
        E: Young's modulus.
        nu: Poisson's ratio.
        yield_stress: above which it flows (von Mises).
        density: mass per volume of a particle.
    """

    shape: str = MISSING
    size: list[float] = MISSING
    centre: list[float] = MISSING
    particles: int = 10000
    E: float = 5000.0
    nu: float = 0.2
    yield_stress: float = 50.0
    density: float = 1.0


@dataclass
class ToolConfig:
    """A kinematic manipulator.

    Attributes:
        shape: one of `rpg.plasticine.physics.SHAPES`.
        size: the numbers named there.
        position: of its origin at the start.
        rotation: at the start, quaternion w, x, y, z (normalised when read).
        motion: one of `MOTIONS`.
        scale: for each degree of freedom of the motion, its change in one environment step under an action of 1
            (length, or radians); 0 leaves that degree of freedom out of the action.
        friction: Coulomb's coefficient against the bodies.
        lower: least position.
        upper: greatest position.
        gap: between the axes of chopsticks at the start.
        min_gap: least gap.
    """

    shape: str = MISSING
    size: list[float] = MISSING
    position: list[float] = MISSING
    rotation: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])
    motion: str = "translate"
    scale: list[float] = field(default_factory=list)
    friction: float = 0.9
    lower: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    upper: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    gap: float = 0.0
    min_gap: float = 0.0


@dataclass
class SceneConfig:
    """Everything a scene is made of.

    Attributes:
        name: for messages and files.
        bodies: pieces of plasticine.
        tools: manipulators, in the order in which they act and in which their actions follow one another.
        target: name of the task in the files of targets, or a .npy file with the masses on a grid; null: no target.
        horizon: environment steps of an episode.
        softness: a of soft contact, strength exp(-a d); 0 is hard contact.
        gravity, floor_friction, grid, dt, substeps, dtype: see `rpg.plasticine.physics.Physics`.
        sweeps: likewise; null takes what the dtype needs, `SWEEPS`.
        particles: total number, shared out as the bodies' own numbers are; null keeps those. Masses of bodies stay.
        E, nu, yield_stress: for all bodies; null keeps each body's own.
        seed: of the random positions of particles; the published tasks have 0.
        targets: public, own, a file of targets, or null: public where RPG_PLASTICINE_TARGETS names its file, else own.
        backend: numba or taichi.
        device: cpu or cuda.
        keep_substeps: of a rollout with gradients, in memory, rather than simulate each environment step once more
            on the way back.
        unstable: take a time step above the stable limit.
        variants: by number, dotted settings that each of them changes.
    """

    name: str = "scene"
    bodies: list[BodyConfig] = field(default_factory=list)
    tools: list[ToolConfig] = field(default_factory=list)
    target: str | None = None
    horizon: int = 50
    softness: float = 666.0
    gravity: list[float] = field(default_factory=lambda: [0.0, -30.0, 0.0])
    floor_friction: float = 1.5
    grid: int = 64
    dt: float = 1e-4
    substeps: int = 19
    dtype: str = "float32"
    sweeps: int | None = None
    particles: int | None = None
    E: float | None = None
    nu: float | None = None
    yield_stress: float | None = None
    seed: int = 0
    targets: str | None = None
    backend: str = "numba"
    device: str = "cpu"
    keep_substeps: bool = False
    unstable: bool = False
    variants: dict[int, dict[str, Any]] = field(default_factory=dict)


_PARTS = {"bodies": BodyConfig, "tools": ToolConfig}


def scene_names() -> tuple[str, ...]:
    """Tasks that come with the package."""
    folder = resources.files("rpg.plasticine") / "tasks"
    return tuple(sorted(Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".yaml")))


def load_config(
    source: str | Path | Mapping[str, Any] | DictConfig,
    variant: int = 1,
    preset: str = "default",
    overrides: Mapping[str, Any] | None = None,
) -> SceneConfig:
    """A scene's settings: file, then variant, then preset, then overrides, each over the one before.

    Args:
        source: a task's name, a YAML file, or the settings themselves.
        variant: which of the scene's variants; a scene without variants has variant 1 alone.
        preset: one of `PRESETS`.
        overrides: settings by dotted name, such as ``{"grid": 32, "tools.0.friction": 0.5}``.

    Raises:
        RPGError: unknown scene, variant, preset or setting; a value that does not fit. One line.
    """
    where, given = _read(source)
    if preset not in PRESETS:
        raise RPGError(f"preset={preset!r} is unknown; {nearest(str(preset), PRESETS)}")
    cfg = OmegaConf.structured(SceneConfig)
    try:
        cfg = OmegaConf.merge(cfg, given)
    except OmegaConfBaseException as error:
        raise _readable(error, where) from error
    variants = cfg.variants or {1: {}}
    if variant not in variants:
        raise RPGError(f"{where}: variant={variant!r} is unknown; known: {', '.join(map(str, variants))}")
    for changes in (variants[variant] or {}, PRESETS[preset]):
        for key, value in changes.items():
            _set(cfg, str(key), value, where)
    if preset == "fast":
        substeps = max(1, round(FAST_SUBSTEPS * cfg.substeps))
        cfg.dt, cfg.substeps = cfg.dt * cfg.substeps / substeps, substeps
    for key, value in (overrides or {}).items():
        _set(cfg, str(key), value, where)
    try:
        config: Any = OmegaConf.to_object(cfg)
    except OmegaConfBaseException as error:
        raise _readable(error, where) from error
    assert isinstance(config, SceneConfig)
    _check(config, where)
    return config


def _read(source: str | Path | Mapping[str, Any] | DictConfig) -> tuple[str, Any]:
    if isinstance(source, Mapping):
        return str(source.get("name", "scene")), source
    text = str(source)
    if text in scene_names():
        path = Path(str(resources.files("rpg.plasticine") / "tasks" / f"{text}.yaml"))
    elif text.endswith((".yaml", ".yml")):
        path = Path(text)
    else:
        raise RPGError(f"scene {text!r} is unknown; {nearest(text, scene_names())}; or give a .yaml file")
    try:
        given = OmegaConf.load(path)
    except FileNotFoundError as error:
        raise RPGError(f"scene file {text!r} does not exist") from error
    except Exception as error:
        raise RPGError(f"scene file {text!r} cannot be read: {_first_line(error)}") from error
    if not isinstance(given, DictConfig):
        raise RPGError(f"scene file {text!r} must hold settings by name")
    return text, given


def _set(cfg: Any, key: str, value: Any, where: str) -> None:
    head, *rest = key.replace("[", ".").replace("]", "").split(".")
    known = [f.name for f in fields(SceneConfig)]
    if head not in known:
        raise RPGError(f"{where}: {key}: unknown setting; {nearest(head, known)}")
    if head in _PARTS and rest and not (rest[0].isdigit() and int(rest[0]) < len(cfg[head])):
        raise RPGError(f"{where}: {key}: {head} are numbered 0 to {len(cfg[head]) - 1}")
    try:
        OmegaConf.update(cfg, key, value, merge=False)
    except OmegaConfBaseException as error:
        raise _readable(error, where, key) from error


def _readable(error: OmegaConfBaseException, where: str, key: str | None = None) -> RPGError:
    full = str(key or error.full_key or error.key or "")
    if isinstance(error, ConfigKeyError | ConfigAttributeError):
        schema: Any = error.object_type if is_dataclass(error.object_type) else SceneConfig
        part = "".join(
            f"{name}: " for name, kind in _PARTS.items() if kind is schema and not full.startswith(name)
        )
        known = [f.name for f in fields(schema)]
        return RPGError(f"{where}: {part}{full}: unknown setting; {nearest(full.split('.')[-1], known)}")
    return RPGError(f"{where}: {full}: {_first_line(error)}")


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0]


def _check(config: SceneConfig, where: str) -> None:
    if not config.bodies:
        raise RPGError(f"{where}: bodies is empty; a scene needs at least one")
    if config.particles is not None and config.particles < len(config.bodies):
        raise RPGError(f"{where}: particles={config.particles} is less than one for each body")
    if config.horizon < 1 or config.softness < 0:
        raise RPGError(
            f"{where}: horizon={config.horizon} must be positive, softness={config.softness} not negative"
        )
    if config.device not in ("cpu", "cuda"):
        raise RPGError(f"{where}: device={config.device!r}: choose cpu or cuda")
    _lengths(config.gravity, 3, f"{where}: gravity")
    for i, body in enumerate(config.bodies):
        _check_body(body, f"{where}: bodies[{i}]")
    for i, tool in enumerate(config.tools):
        _check_tool(tool, f"{where}: tools[{i}]")


def _check_body(body: BodyConfig, where: str) -> None:
    if body.shape not in BODY_SHAPES:
        raise RPGError(f"{where}.shape={body.shape!r} is unknown; {nearest(body.shape, BODY_SHAPES)}")
    _lengths(body.size, len(BODY_SHAPES[body.shape]), f"{where}.size")
    _lengths(body.centre, 3, f"{where}.centre")
    for name in ("particles", "E", "density", "yield_stress"):
        if not getattr(body, name) > 0:
            raise RPGError(f"{where}.{name}={getattr(body, name)} must be positive")
    if not -1.0 < body.nu < 0.5:
        raise RPGError(f"{where}.nu={body.nu} must lie between -1 and 0.5")
    half = [s / 2 for s in body.size] if body.shape == "box" else body.size * 3
    for axis, middle, reach in zip("xyz", body.centre, half, strict=True):
        # Bodies of the published tasks stand on the floor at exactly 0.
        if middle - reach < -1e-9 or middle + reach > 1.0 + 1e-9:
            raise RPGError(
                f"{where} reaches from {middle - reach:.4g} to {middle + reach:.4g} in {axis}; keep 0 to 1"
            )


def _check_tool(tool: ToolConfig, where: str) -> None:
    if tool.motion not in MOTIONS:
        raise RPGError(f"{where}.motion={tool.motion!r} is unknown; {nearest(tool.motion, MOTIONS)}")
    freedoms = MOTIONS[tool.motion]
    if len(tool.scale) != len(freedoms):
        named = ", ".join(freedoms) or "nothing"
        raise RPGError(
            f"{where}.scale={list(tool.scale)}: motion {tool.motion} needs a number for each of ({named})"
        )
    for name, count in (("position", 3), ("rotation", 4), ("lower", 3), ("upper", 3)):
        _lengths(getattr(tool, name), count, f"{where}.{name}")
    if sum(q * q for q in tool.rotation) < 1e-12:
        raise RPGError(f"{where}.rotation={list(tool.rotation)} is no rotation; a quaternion is not zero")
    if tool.motion == "roll" and tool.shape != "capsule":
        raise RPGError(f"{where}.shape={tool.shape!r}: motion roll is for a capsule")
    if (tool.motion == "chopsticks") != (tool.shape == "chopsticks"):
        raise RPGError(f"{where}: shape={tool.shape!r} does not go with motion={tool.motion!r}")
    if tool.gap < tool.min_gap or tool.min_gap < 0:
        raise RPGError(
            f"{where}.gap={tool.gap} must be at least min_gap={tool.min_gap}, and that not negative"
        )
    for axis, low, at, high in zip("xyz", tool.lower, tool.position, tool.upper, strict=True):
        if not low <= at <= high:
            raise RPGError(f"{where}.position is {at} in {axis}, outside lower={low} and upper={high}")


def _lengths(values: list[float], count: int, what: str) -> None:
    if len(values) != count:
        raise RPGError(f"{what}={list(values)} needs {count} numbers")
