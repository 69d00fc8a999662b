"""The Taichi backend: its adjoint against central differences, its result against the other backend, its manners."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from importlib.util import find_spec

import pytest
import torch

from rpg.errors import RPGError
from rpg.plasticine.backend import Backend, Particles
from rpg.plasticine.physics import Physics, Tool
from rpg.plasticine.simulator import make_backend

pytest.importorskip("taichi")

COUNT = 30
SOFT = 666.0
SPHERE = (Tool("sphere", (0.03,)),)
EVERY = (
    Tool("sphere", (0.03,)),
    Tool("capsule", (0.03, 0.02)),
    Tool("box", (0.03, 0.02, 0.04)),
    Tool("cylinder", (0.03, 0.02)),
    Tool("torus", (0.03, 0.015)),
    Tool("chopsticks", (0.05, 0.015), friction=0.3),
)
TOOLS = {"sphere": SPHERE, "every": EVERY, "none": ()}
# What a step of size 1 in the directions below is, so that one relative step suits all inputs.
SCALES = {"x": 0.01, "v": 1.0, "C": 10.0, "b": 0.1, "mu": 2e3, "lambda": 2e3, "yield": 50.0, "motion": 1.0}
Inputs = tuple[Particles, torch.Tensor, torch.Tensor]


@cache
def backend(
    name: str, tools: str, dtype: str, substeps: int, friction: float = 1.5, count: int = COUNT
) -> Backend:
    physics = Physics(substeps=substeps, dtype=dtype, floor_friction=friction)  # type: ignore[arg-type]
    mass = torch.full((count,), 6.1e-5)
    mass[::3] *= 2
    return make_backend(name, physics, TOOLS[tools], mass, torch.full((count,), 6.1e-5), "cpu")


def inputs(
    of: Backend,
    scenes: int = 2,
    seed: int = 0,
    strain: float = 0.02,
    yield_stress: float = 50.0,
    centre: tuple[float, float, float] = (0.5, 0.05, 0.5),
    speed: float = 1.0,
) -> Inputs:
    """Random particles in a small box, with tools turned at random that overlap them."""
    generator = torch.Generator().manual_seed(seed)
    count = len(of._mass)  # type: ignore[attr-defined]
    middle = torch.tensor(centre, dtype=torch.float64)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    uniform = torch.rand(scenes, count, 3, generator=generator, dtype=torch.float64)
    stretch = torch.eye(3, dtype=torch.float64) + strain * normal(scenes, count, 3, 3)
    b = (stretch @ stretch.mT)[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    particles = (
        middle + 0.08 * (uniform - 0.5),
        speed * normal(scenes, count, 3),
        20 * normal(scenes, count, 3, 3),
        b,
    )
    elastic = torch.tensor([2083.3, 1388.9, yield_stress], dtype=torch.float64)
    material = elastic * (1 + 0.1 * torch.rand(scenes, count, 3, generator=generator, dtype=torch.float64))
    motion = normal(scenes, of.physics.substeps, len(of.tools), 25)
    motion[..., :3] = middle + 0.03 * motion[:, :1, :, :3]
    turn = motion[:, :1, :, 3:12].unflatten(-1, (3, 3))
    motion[..., 3:12] = torch.linalg.matrix_exp(turn - turn.mT).flatten(-2)
    motion[..., 12:24] *= 3
    motion[..., 24] = 0.06
    dtype = getattr(torch, of.physics.dtype)
    return Particles(*(part.to(dtype) for part in particles)), material.to(dtype), motion.to(dtype)


def cotangent(like: Particles) -> Particles:
    generator = torch.Generator().manual_seed(1)
    scales = Particles(50.0, 1.0, 0.02, 10.0)  # type: ignore[arg-type]
    return Particles(
        *(
            torch.randn(p.shape, generator=generator, dtype=p.dtype) * s
            for p, s in zip(like, scales, strict=True)
        )
    )


def moved(at: Inputs, name: str, step: torch.Tensor) -> Inputs:
    particles, material, motion = at
    if name == "motion":
        return particles, material, motion + step
    if name in SCALES and name in Particles._fields:
        return particles._replace(**{name: getattr(particles, name) + step}), material, motion
    return particles, material + step, motion


def assert_adjoint(of: Backend, at: Inputs, softness: float, names: tuple[str, ...] = tuple(SCALES)) -> None:
    """Every adjoint, along a direction in which no contributions cancel, equals a central difference."""
    weights = cotangent(of.step(*at, softness))
    gradient = of.step_backward(*at, softness, weights)
    adjoints = dict(zip(Particles._fields, gradient.particles, strict=True)) | {"motion": gradient.motion}
    generator = torch.Generator().manual_seed(2)
    for name in names:
        adjoint = adjoints.get(name, gradient.material)
        direction = adjoint.sign() * torch.rand(adjoint.shape, generator=generator, dtype=adjoint.dtype)
        if name not in adjoints:
            direction *= torch.eye(3, dtype=adjoint.dtype)[("mu", "lambda", "yield").index(name)]
        step = 1e-6 * SCALES[name]

        def objective(size: float, name: str = name, direction: torch.Tensor = direction) -> float:
            after = of.step(*moved(at, name, size * direction), softness)
            return sum(float((part * weight).sum()) for part, weight in zip(after, weights, strict=True))

        difference = (objective(step) - objective(-step)) / (2 * step)
        assert difference == pytest.approx(float((adjoint * direction).sum()), rel=1e-4, abs=1e-8), name


@pytest.mark.parametrize("softness", [SOFT, 30.0, 0.0])
def test_adjoint_of_a_substep_with_every_shape(softness: float) -> None:
    of = backend("taichi", "every", "float64", 1)
    assert_adjoint(of, inputs(of), softness)


def test_adjoint_of_an_environment_step() -> None:
    of = backend("taichi", "sphere", "float64", 19)
    assert_adjoint(of, inputs(of, speed=0.3), SOFT)


@pytest.mark.parametrize("friction", [0.0, 100.0])
def test_adjoint_on_slippery_and_sticky_floors(friction: float) -> None:
    of = backend("taichi", "sphere", "float64", 2, friction)
    assert_adjoint(of, inputs(of), SOFT)


@pytest.mark.parametrize("centre", [(0.03, 0.03, 0.95), (0.95, 0.93, 0.03)])
def test_adjoint_at_the_walls(centre: tuple[float, float, float]) -> None:
    of = backend("taichi", "sphere", "float64", 1)
    assert_adjoint(of, inputs(of, centre=centre), SOFT)


@pytest.mark.parametrize("yield_stress", [1.0, 1e4])
@pytest.mark.parametrize("spectrum", [(1.0, 1.0, 1.0), (0.9, 0.9, 0.9), (1.1, 1.0, 1.0), (1.2, 0.8, 0.8)])
def test_adjoint_of_degenerate_strain(spectrum: tuple[float, float, float], yield_stress: float) -> None:
    of = backend("taichi", "sphere", "float64", 1)
    particles, material, motion = inputs(of, yield_stress=yield_stress)
    b = torch.zeros_like(particles.b)
    b[..., [0, 3, 5]] = torch.tensor(spectrum, dtype=b.dtype)
    at = particles._replace(b=b, C=torch.zeros_like(particles.C)), material, motion
    assert_adjoint(
        of, at, SOFT, ("x", "v", "b", "mu", "lambda", "yield") if yield_stress == 1.0 else ("x", "C", "b")
    )
    assert all(part.isfinite().all() for part in of.step_backward(*at, SOFT, cotangent(particles)).particles)


@pytest.mark.parametrize("dust", [0.0, 1e-40, 1e-23, 1e-20, 1e-18, 1e-15])
def test_strain_far_below_rounding_does_no_harm(dust: float) -> None:
    """Squares underflow in the eigenproblem, and at this yield stress even rest is mapped back."""
    of = backend("taichi", "sphere", "float32", 19)
    particles, material, motion = inputs(of, speed=0.0, yield_stress=0.1)
    b = torch.zeros_like(particles.b)
    b[..., [0, 3, 5]] = 1.0
    b[..., [1, 2, 4]] = dust
    still = particles._replace(b=b, C=torch.zeros_like(particles.C))
    after = of.step(still, material, torch.zeros_like(motion), SOFT)
    wanted = of.step(still._replace(b=b.clamp(max=1.0).round()), material, torch.zeros_like(motion), SOFT)
    assert (after.x - wanted.x).abs().max() < 1e-6
    assert (after.b - wanted.b).abs().max() < 1e-5


def test_single_precision_agrees_with_double() -> None:
    single, double = (backend("taichi", "sphere", dtype, 19) for dtype in ("float32", "float64"))
    at = inputs(double, speed=0.3)
    rounded = Particles(*(part.float() for part in at[0])), at[1].float(), at[2].float()
    after, wanted = single.step(*rounded, SOFT), double.step(*at, SOFT)
    assert (after.x - wanted.x).abs().max() < 1e-6
    weights = cotangent(wanted)
    gradient = single.step_backward(*rounded, SOFT, Particles(*(part.float() for part in weights)))
    exact = double.step_backward(*at, SOFT, weights)
    for part, truth in zip((*gradient.particles, *gradient[1:]), (*exact.particles, *exact[1:]), strict=True):
        assert part.dtype == torch.float32
        assert (part - truth).norm() < 2e-2 * truth.norm()


def test_scenes_of_a_batch_do_not_mix() -> None:
    of = backend("taichi", "sphere", "float64", 2)
    particles, material, motion = inputs(of, scenes=3)
    together = of.step(particles, material, motion, SOFT)
    for scene in range(3):
        one = slice(scene, scene + 1)
        alone = of.step(Particles(*(part[one] for part in particles)), material[one], motion[one], SOFT)
        torch.testing.assert_close(alone, Particles(*(part[one] for part in together)), rtol=1e-9, atol=1e-12)


def test_atomic_lanes_of_a_gpu_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    from rpg.plasticine.taichi_backend import backend as module

    of = backend("taichi", "sphere", "float64", 2)
    atomic = module.TaichiBackend(of.physics, of.tools, of._mass, of._volume, "cpu")  # type: ignore[attr-defined]
    monkeypatch.setattr(atomic, "_private", False)
    physics = of.physics
    kernels = module._particle_kernels(physics.dtype, physics.grid, physics.dt, physics.sweeps, False)
    monkeypatch.setattr(atomic, "_particles", kernels)
    monkeypatch.setattr(atomic, "_masses", module._mass_kernels(physics.dtype, physics.grid, False))
    at = inputs(of)
    weights = cotangent(at[0])
    torch.testing.assert_close(atomic.step(*at, SOFT), of.step(*at, SOFT), rtol=1e-9, atol=1e-11)
    got, wanted = (each.step_backward(*at, SOFT, weights) for each in (atomic, of))
    torch.testing.assert_close(got.particles, wanted.particles, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(got.motion, wanted.motion, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(atomic.grid_mass(at[0].x), of.grid_mass(at[0].x))


def test_particles_that_leave_the_window_find_a_wider_one(monkeypatch: pytest.MonkeyPatch) -> None:
    from rpg.plasticine.taichi_backend import backend as module

    of = backend("taichi", "none", "float64", 19)
    particles, material, motion = inputs(of, yield_stress=1e4, centre=(0.5, 0.5, 0.5))
    # Squeezed to half its size it bursts apart, at rest it looks calm.
    still = particles._replace(
        b=0.25 * particles.b, v=torch.zeros_like(particles.v), C=torch.zeros_like(particles.C)
    )
    seen: list[tuple[int, int, int]] = []
    enclosing = module.enclosing

    def spy(*arguments: object) -> object:
        window = enclosing(*arguments)  # type: ignore[arg-type]
        seen.append(window.size)
        return window

    monkeypatch.setattr(module, "enclosing", spy)
    tight = of.step(still, material, motion, SOFT)
    assert 1 < len(seen) < 4
    assert max(seen[-1]) < of.physics.grid + 2
    monkeypatch.setattr(module, "_WIDER", (1 << 20,))
    torch.testing.assert_close(tight, of.step(still, material, motion, SOFT), rtol=1e-9, atol=1e-12)


def test_only_the_backward_pass_keeps_substeps(monkeypatch: pytest.MonkeyPatch) -> None:
    of = backend("taichi", "sphere", "float64", 19)
    slots: list[int] = []
    buffers = of._buffers  # type: ignore[attr-defined]

    def spy(*arguments: object) -> object:
        run = buffers(*arguments)
        slots.append(len(run.states))
        return run

    monkeypatch.setattr(of, "_buffers", spy)
    at = inputs(of, speed=0.3)
    after = of.step(*at, SOFT)
    assert set(slots) == {2}
    assert after.x.untyped_storage().nbytes() == at[0].x.nbytes
    slots.clear()
    of.step_backward(*at, SOFT, cotangent(at[0]))
    assert set(slots) == {20}


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("field", Particles._fields)
def test_what_is_not_finite_shows_and_stays_in_its_scene(field: str, bad: float) -> None:
    of = backend("taichi", "sphere", "float64", 2)
    particles, material, motion = inputs(of)
    broken = getattr(particles, field).clone()
    broken[0, 0] = bad
    after = of.step(particles._replace(**{field: broken}), material, motion, SOFT)
    whole = of.step(particles, material, motion, SOFT)
    torch.testing.assert_close(Particles(*(p[1] for p in after)), Particles(*(p[1] for p in whole)))
    if bad != bad:
        assert not all(part[0].isfinite().all() for part in after)
    of.step_backward(particles._replace(**{field: broken}), material, motion, SOFT, cotangent(particles))


def test_grid_mass_and_its_adjoint() -> None:
    of = backend("taichi", "sphere", "float64", 1)
    x = inputs(of, centre=(0.5, 0.5, 0.02))[0].x
    mass = of.grid_mass(x)
    inner = (x[..., 2] * 64 >= 0.5).all(1)
    assert mass.shape == (2, 64, 64, 64)
    total = of._mass.sum()  # type: ignore[attr-defined]
    assert (mass.sum((1, 2, 3)) <= total + 1e-12).all()
    torch.testing.assert_close(mass.sum((1, 2, 3))[inner], total.expand(int(inner.sum())))
    weights = torch.randn(mass.shape, generator=torch.Generator().manual_seed(3), dtype=x.dtype)
    adjoint = of.grid_mass_backward(x, weights)
    step = 1e-7 * adjoint.sign()
    difference = ((of.grid_mass(x + step) - of.grid_mass(x - step)) * weights).sum() / 2e-7
    assert difference.item() == pytest.approx(adjoint.abs().sum().item(), rel=1e-6)


def test_wrong_shapes_are_refused() -> None:
    of = backend("taichi", "sphere", "float64", 1)
    particles, material, motion = inputs(of)
    with pytest.raises(RPGError, match=r"motion is \(2, 1, 1, 24\)"):
        of.step(particles, material, motion[..., :24], SOFT)
    with pytest.raises(RPGError, match=r"needs \(2, 30, 3\) torch.float64"):
        of.step(particles._replace(v=particles.v.float()), material, motion, SOFT)


OTHER = pytest.mark.skipif(
    find_spec("numba") is None or find_spec("rpg.plasticine.numba_backend") is None,
    reason="numba is not installed",
)


@OTHER
@pytest.mark.parametrize(("tools", "substeps"), [("every", 1), ("sphere", 19)])
@pytest.mark.parametrize("softness", [SOFT, 0.0])
def test_double_precision_agrees_with_numba(tools: str, substeps: int, softness: float) -> None:
    ours, theirs = (backend(name, tools, "float64", substeps) for name in ("taichi", "numba"))
    at = inputs(ours)
    after, wanted = (each.step(*at, softness) for each in (ours, theirs))
    weights = cotangent(wanted)
    gradient, truth = (each.step_backward(*at, softness, weights) for each in (ours, theirs))
    got, expected = (*after, *gradient.particles, *gradient[1:]), (*wanted, *truth.particles, *truth[1:])
    for part, other in zip(got, expected, strict=True):
        assert (part - other).norm() <= 1e-6 * other.norm()
    torch.testing.assert_close(ours.grid_mass(after.x), theirs.grid_mass(after.x))


@OTHER
def test_single_precision_stays_with_numba_for_an_episode() -> None:
    ours, theirs = (backend(name, "sphere", "float32", 19, count=400) for name in ("taichi", "numba"))
    particles, material, motion = inputs(ours, strain=0.0, speed=0.0)
    motion = torch.zeros_like(motion)
    motion[..., :3] = torch.tensor([0.5, 0.13, 0.5])
    motion[..., [3, 7, 11]] = 1.0
    motion[..., 13] = -0.5
    start = particles._replace(C=torch.zeros_like(particles.C))
    means = []
    for each in (ours, theirs):
        state = start
        for step in range(50):
            motion[..., 1] = 0.13 - 0.5 * 1e-4 * (19 * step + torch.arange(19)[:, None])
            state = each.step(state, material, motion, SOFT)
        means.append(state.x.mean(1))
    assert (means[0] - means[1]).abs().max() < 1e-4
    assert (means[0][:, 1] < start.x.mean(1)[:, 1] - 0.001).all()


def test_a_second_device_gets_a_clear_answer() -> None:
    backend("taichi", "sphere", "float64", 1)
    with pytest.raises(
        RPGError, match="taichi runs on cpu in this process; start another process for device='cuda'"
    ):
        make_backend("taichi", Physics(), (), torch.ones(1), torch.ones(1), "cuda")
    with pytest.raises(RPGError, match="device='meta' is unknown"):
        make_backend("taichi", Physics(), (), torch.ones(1), torch.ones(1), "meta")


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_importing_the_simulator_imports_no_compiler() -> None:
    code = (
        "import sys, rpg.plasticine, rpg.plasticine.simulator\n"
        "print([name for name in ('taichi', 'quadrants', 'numba') if name in sys.modules])"
    )
    result = python(code)
    assert result.stdout.strip() == "[]", result.stderr


def test_the_module_is_chosen_by_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    from rpg.plasticine import taichi_module

    monkeypatch.setenv("RPG_TAICHI", "warp")
    with pytest.raises(RPGError, match="RPG_TAICHI='warp' is unknown; use one of taichi, quadrants"):
        taichi_module._load()


def test_it_starts_quietly() -> None:
    result = python("from rpg.plasticine.taichi_module import start; start('cpu')")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
