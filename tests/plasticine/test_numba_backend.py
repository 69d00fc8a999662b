from __future__ import annotations

import math
import multiprocessing
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from rpg.errors import RPGError
from rpg.plasticine.backend import MOTION, MOTION_SIZE, Particles
from rpg.plasticine.physics import Physics, Tool

pytest.importorskip("numba")
from rpg.plasticine.numba_backend import NumbaBackend
from rpg.plasticine.numba_backend.crew import Crew

TOOLS = {
    "sphere": (0.08,),
    "capsule": (0.2, 0.05),
    "box": (0.07, 0.05, 0.09),
    "cylinder": (0.07, 0.06),
    "torus": (0.08, 0.04),
    "chopsticks": (0.2, 0.03),
}
COUNT = 40
Scene = tuple[Particles, torch.Tensor, torch.Tensor]


@pytest.fixture
def threads() -> Iterator[Any]:
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def rotation(generator: torch.Generator) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return q * torch.linalg.det(q)


def random_motion(generator: torch.Generator, shape: tuple[int, ...]) -> torch.Tensor:
    motion = torch.zeros(*shape, MOTION_SIZE, dtype=torch.float64)
    motion[..., MOTION["origin"]] = torch.tensor([0.5, 0.3, 0.5], dtype=torch.float64)
    motion[..., MOTION["origin"]] += 0.03 * torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    motion[..., MOTION["rotation"]] = rotation(generator).reshape(9)
    motion[..., MOTION["linear"]] = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    motion[..., MOTION["spin"]] = 3 * torch.randn(*shape, 9, generator=generator, dtype=torch.float64)
    motion[..., MOTION["gap"]] = 0.1
    return motion


def random_scene(
    seed: int = 0, tools: int = 1, substeps: int = 1, batch: int = 1, strain: float = 0.02
) -> Scene:
    """Particles on the floor of a coarse grid with tools among them, moving and strained at random; some yield."""
    g = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> torch.Tensor:
        return torch.randn(batch, COUNT, *shape, generator=g, dtype=torch.float64)

    x = (
        0.05
        + 0.9
        * torch.rand(batch, COUNT, 3, generator=g, dtype=torch.float64)
        * torch.tensor([1, 0.5, 1])
        * 0.35
    )
    x = x + torch.tensor([0.28, 0.0, 0.28], dtype=torch.float64)
    f = torch.eye(3, dtype=torch.float64) + strain * randn(3, 3)
    b = f @ f.mT
    material = torch.tensor([2083.3, 1388.9, 50.0], dtype=torch.float64) * (1 + 0.1 * randn(3))
    particles = Particles(x, randn(3), 20 * randn(3, 3), b.flatten(2)[..., [0, 1, 2, 4, 5, 8]].contiguous())
    return particles, material, random_motion(g, (batch, substeps, tools))


def make(
    shapes: tuple[str, ...] = (), dtype: Any = "float64", mass: float = 6e-5, **settings: Any
) -> NumbaBackend:
    physics = Physics(**{"grid": 16, "substeps": 1, "sweeps": 6, **settings}, dtype=dtype)
    tools = tuple(Tool(shape, TOOLS[shape], friction=0.4) for shape in shapes)  # type: ignore[arg-type]
    masses = mass * torch.linspace(0.5, 1.5, COUNT, dtype=torch.float64)
    return NumbaBackend(physics, tools, masses, 1.1 * masses, "cpu")


def described(backend: NumbaBackend) -> tuple[Any, ...]:
    """What the backend was built from."""
    return backend.physics, backend.tools, torch.from_numpy(backend._mass), torch.from_numpy(backend._volume)


def leaves(scene: Scene) -> list[torch.Tensor]:
    return [t.clone().requires_grad_() for t in (*scene[0], scene[1], scene[2])]


def weights(particles: Particles, seed: int = 5) -> Particles:
    """Adjoints of about the same influence for every field."""
    g = torch.Generator().manual_seed(seed)
    scales = (10.0, 1.0, 0.01, 1.0)
    random = (
        s * torch.randn(f.shape, generator=g, dtype=torch.float64)
        for s, f in zip(scales, particles, strict=True)
    )
    return Particles(*(r.to(particles.x.dtype) for r in random))


def close(a: torch.Tensor, b: torch.Tensor, tolerance: float) -> None:
    assert (a - b).abs().max() <= tolerance * (b.abs().max() + 1e-12), (a - b).abs().max() / b.abs().max()


CASES = [(shape, 30.0, 0.6) for shape in TOOLS] + [("sphere", 0.0, 12.0), ("capsule", 666.0, 0.0)]


@pytest.mark.parametrize(("shape", "softness", "floor"), CASES)
def test_a_substep_and_its_adjoint_are_those_of_plain_torch(
    shape: str, softness: float, floor: float, plain_substep: Any
) -> None:
    backend = make((shape, "sphere"), floor_friction=floor)
    scene = random_scene(tools=2)
    inputs = leaves(scene)
    expected = plain_substep(*described(backend), (Particles(*inputs[:4]), inputs[4], inputs[5]), softness)
    found = backend.step(*scene, softness)
    for ours, theirs in zip(found, expected, strict=True):
        close(ours, theirs.detach(), 1e-10)
    gradient = weights(found)
    loss = sum((g * e).sum() for g, e in zip(gradient, expected, strict=True))
    wanted = torch.autograd.grad(loss, inputs)
    adjoint = backend.step_backward(*scene, softness, gradient)
    for ours, theirs in zip((*adjoint.particles, adjoint.material, adjoint.motion), wanted, strict=True):
        assert theirs.abs().max() > 0
        close(ours, theirs, 1e-7)


@pytest.mark.parametrize("corner", [(0.05, 0.02, 0.05), (0.8, 0.8, 0.8)])
def test_walls_and_the_edge_of_the_domain_are_those_of_plain_torch(
    corner: tuple[float, ...], plain_substep: Any
) -> None:
    backend = make()
    particles, material, motion = random_scene(tools=0)
    x = torch.tensor(corner, dtype=torch.float64) + 0.1 * particles.x
    x[0, 0] = torch.tensor([0.001, 0.002, 0.003]) if corner[0] < 0.5 else 1 - 3.001 / 16
    particles = particles._replace(x=x, v=particles.v * 30)
    scene = particles, material, motion
    inputs = leaves(scene)
    expected = plain_substep(*described(backend), (Particles(*inputs[:4]), inputs[4], inputs[5]), 0.0)
    gradient = weights(particles)
    loss = sum((g * e).sum() for g, e in zip(gradient, expected, strict=True))
    wanted = torch.autograd.grad(loss, inputs[:5])
    adjoint = backend.step_backward(*scene, 0.0, gradient)
    for ours, theirs in zip(backend.step(*scene, 0.0), expected, strict=True):
        close(ours, theirs.detach(), 1e-10)
    for ours, theirs in zip((*adjoint.particles, adjoint.material), wanted, strict=True):
        close(ours, theirs, 1e-7)


def differences(backend: NumbaBackend, scene: Scene, softness: float, step: float = 1e-6) -> None:
    """Compare the adjoint with central differences, in a random direction of every input."""
    inputs = [*scene[0], scene[1], scene[2]]
    gradient = weights(scene[0])
    adjoint = backend.step_backward(*scene, softness, gradient)
    ours = (*adjoint.particles, adjoint.material, adjoint.motion)
    scales = (1e-2, 1.0, 100.0, 1.0, 100.0, 0.1)
    for n, scale in enumerate(scales):
        if not inputs[n].numel():
            continue
        direction = scale * torch.randn(
            inputs[n].shape, generator=torch.Generator().manual_seed(n), dtype=torch.float64
        )
        sides = []
        for sign in (1, -1):
            moved = [t + sign * step * direction if m == n else t for m, t in enumerate(inputs)]
            after = backend.step(Particles(*moved[:4]), moved[4], moved[5], softness)
            sides.append(sum((g * a).sum() for g, a in zip(gradient, after, strict=True)))
        wanted = (sides[0] - sides[1]) / (2 * step)
        found = (ours[n] * direction).sum()
        assert found.item() == pytest.approx(wanted.item(), rel=1e-4, abs=1e-7), n


@pytest.mark.parametrize("shape", TOOLS)
def test_the_adjoint_of_an_environment_step_agrees_with_differences(shape: str) -> None:
    backend = make((shape,), substeps=19, grid=24, floor_friction=0.5)
    differences(backend, random_scene(seed=1, substeps=19), 666.0, step=1e-7)


SPECTRA = {
    "rest": (1.0, 1.0, 1.0),
    "compressed": (0.9, 0.9, 0.9),
    "stretched a little": (1.01, 1.0, 1.0),
    "stretched": (1.3, 1.0, 1.0),
    "squeezed": (0.7, 0.7, 1.2),
    "nearly equal": (1.0, 1.0 + 1e-9, 1.0 - 1e-9),
    "crushed": (0.001, 1.1, 1.3),
}


@pytest.mark.parametrize("name", SPECTRA)
@pytest.mark.parametrize("turned", [False, True])
def test_the_adjoint_is_exact_where_eigenvalues_are_equal(name: str, turned: bool) -> None:
    backend = make()
    particles, material, motion = random_scene(tools=0)
    u = rotation(torch.Generator().manual_seed(3)) if turned else torch.eye(3, dtype=torch.float64)
    b = u @ torch.diag(torch.tensor(SPECTRA[name], dtype=torch.float64)) @ u.T
    six = b.flatten()[[0, 1, 2, 4, 5, 8]].expand(1, COUNT, 6).contiguous()
    particles = particles._replace(b=six, C=torch.zeros_like(particles.C))
    differences(backend, (particles, material, motion), 0.0)


def test_float32_follows_float64() -> None:
    scene = random_scene(substeps=19, strain=0.01)
    exact = make(("sphere",), substeps=19)
    rough = make(("sphere",), "float32", substeps=19, sweeps=3)
    particles, material, motion = (
        Particles(*(f.float() for f in scene[0])),
        scene[1].float(),
        scene[2].float(),
    )
    for a, b in zip(rough.step(particles, material, motion, 30.0), exact.step(*scene, 30.0), strict=True):
        assert a.dtype == torch.float32
        close(a.double(), b, 1e-4)
    gradient = weights(scene[0])
    a = rough.step_backward(particles, material, motion, 30.0, Particles(*(f.float() for f in gradient)))
    b = exact.step_backward(*scene, 30.0, gradient)
    for ours, theirs in zip((*a.particles, a.motion), (*b.particles, b.motion), strict=True):
        assert torch.nn.functional.cosine_similarity(ours.double().flatten(), theirs.flatten(), 0) > 0.9999


def test_free_fall_keeps_momentum() -> None:
    backend = make(substeps=19, mass=1.0)
    particles, material, motion = random_scene(tools=0, substeps=19)
    particles = particles._replace(x=particles.x * 0.5 + 0.3)
    after = backend.step(particles, material, motion, 0.0)
    mass = torch.from_numpy(backend._mass)[:, None]
    before = (mass * particles.v[0]).sum(0)
    fall = 19 * backend.physics.dt * torch.tensor(backend.physics.gravity, dtype=torch.float64) * mass.sum()
    close((mass * after.v[0]).sum(0), before + fall, 1e-12)


def test_grid_mass_and_its_adjoint() -> None:
    backend = make()
    x = random_scene(batch=2)[0].x.clamp(min=0.1)
    nodes = backend.grid_mass(x)
    assert nodes.shape == (2, 16, 16, 16)
    assert nodes.sum((1, 2, 3)).tolist() == pytest.approx([backend._mass.sum()] * 2, rel=1e-12)
    assert (nodes * torch.arange(16)[:, None, None]).sum().item() / 16 == pytest.approx(
        (x[..., 0] * torch.from_numpy(backend._mass)).sum().item(), rel=1e-12
    )
    g = torch.Generator().manual_seed(0)
    pull, direction = (torch.randn(t.shape, generator=g, dtype=torch.float64) for t in (nodes, x))
    sides = [(pull * backend.grid_mass(x + sign * 1e-6 * direction)).sum() for sign in (1, -1)]
    found = (backend.grid_mass_backward(x, pull) * direction).sum()
    assert found.item() == pytest.approx((sides[0] - sides[1]).item() / 2e-6, rel=1e-6)


@pytest.mark.parametrize("batch", [1, 2, 3])
def test_threads_and_batches_change_nothing(batch: int, threads: Any) -> None:
    backend = make(("sphere", "capsule"), substeps=19)
    scene = random_scene(tools=2, substeps=19, batch=batch)
    gradient = weights(scene[0])
    threads(2)
    together = backend.step(*scene, 30.0), backend.step_backward(*scene, 30.0, gradient)
    threads(1)
    for n in range(batch):
        alone: Scene = Particles(*(f[n : n + 1] for f in scene[0])), scene[1][n : n + 1], scene[2][n : n + 1]
        after = backend.step(*alone, 30.0)
        adjoint = backend.step_backward(*alone, 30.0, Particles(*(f[n : n + 1] for f in gradient)))
        for ours, theirs in zip(together[0], after, strict=True):
            close(ours[n], theirs[0], 1e-11)
        both = zip(
            (*together[1].particles, together[1].material, together[1].motion),
            (*adjoint.particles, adjoint.material, adjoint.motion),
            strict=True,
        )
        for ours, theirs in both:
            close(ours[n], theirs[0], 1e-8)


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("after", [1, 2])
def test_a_recorded_step_has_the_same_adjoint(batch: int, after: int, threads: Any) -> None:
    """Also by another number of threads than recorded it."""
    backend = make(("sphere", "capsule"), substeps=19)
    backend._nodes = 64  # has to grow while it records
    scene = random_scene(tools=2, substeps=19, batch=batch)
    gradient = weights(scene[0])
    threads(2)
    found, recording = backend.record(*scene, 30.0)
    other = random_scene(tools=2, seed=5, substeps=19, batch=batch)
    backend.step_backward(*other, 30.0, gradient)  # in between, on the same scratch
    for ours, theirs in zip(found, backend.step(*scene, 30.0), strict=True):
        assert ours.equal(theirs)
    wanted = backend.step_backward(*scene, 30.0, gradient)
    threads(after)
    adjoint = backend.step_backward(*scene, 30.0, gradient, recording)
    both = zip(
        (*adjoint.particles, adjoint.material, adjoint.motion),
        (*wanted.particles, wanted.material, wanted.motion),
        strict=True,
    )
    for ours, theirs in both:
        close(ours, theirs, 1e-12 if after == 2 else 1e-8)


def test_particles_that_race_through_the_grid_are_followed() -> None:
    """Their rows of nodes change many times in a step: the layout has to follow them."""
    one, many = make(substeps=1, dt=1e-3), make(substeps=19, dt=1e-3)
    particles, material, motion = random_scene(tools=0)
    particles = particles._replace(v=particles.v * 20)
    scene = particles, 0.001 * material, motion.expand(1, 19, 0, MOTION_SIZE)
    after = particles
    for _ in range(19):
        after = one.step(after, scene[1], motion, 0.0)
    assert (after.x - particles.x).abs().max() > 0.2
    for ours, theirs in zip(many.step(*scene, 0.0), after, strict=True):
        close(ours, theirs, 1e-9)
    differences(many, scene, 0.0, step=1e-8)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30, -1e30])
@pytest.mark.parametrize("field", Particles._fields)
def test_what_is_not_finite_stays_within_memory_and_shows(bad: float, field: str, threads: Any) -> None:
    threads(2)
    backend = make(("sphere",), substeps=19)
    scene = random_scene(substeps=19)
    values = getattr(scene[0], field).clone()
    values.view(-1)[0] = bad
    particles = scene[0]._replace(**{field: values})
    after = backend.step(particles, scene[1], scene[2], 30.0)
    backend.step_backward(particles, scene[1], scene[2], 30.0, weights(scene[0]))
    if math.isnan(bad):
        assert any(f.isnan().any() for f in after)
    fresh = backend.step(*scene, 30.0)
    assert all(f.isfinite().all() for f in fresh)


def test_two_threads_of_the_interpreter_may_step_at_the_same_time(threads: Any) -> None:
    threads(2)
    scene = random_scene(substeps=19)
    backends = [make(("sphere",), substeps=19) for _ in range(3)]
    expected = backends[0].step(*scene, 30.0)
    results: list[Particles] = []
    workers = [
        threading.Thread(target=lambda b=b: results.extend(b.step(*scene, 30.0) for _ in range(5)))
        for b in backends
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(results) == 15
    for result in results:
        close(result.x, expected.x, 1e-12)


def _step_in_child(backend: NumbaBackend, scene: Scene, pipe: Any) -> None:
    pipe.send(backend.step(*scene, 30.0).x.numpy())


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork")
def test_a_forked_child_may_step(threads: Any) -> None:
    threads(2)
    backend, scene = make(("sphere",), substeps=19), random_scene(substeps=19)
    expected = backend.step(*scene, 30.0)
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_step_in_child, args=(backend, scene, theirs))
    child.start()
    assert ours.poll(60)
    close(torch.from_numpy(ours.recv()), expected.x, 1e-12)
    child.join()


def test_a_failure_in_one_thread_reaches_the_caller() -> None:
    aborted = threading.Event()

    def fail() -> None:
        raise ValueError("lost")

    with pytest.raises(ValueError, match="lost"):
        Crew().run([lambda: aborted.wait(20), fail], aborted.set)
    assert aborted.is_set()


def test_a_wrong_shape_dtype_or_device_is_named() -> None:
    backend = make()
    particles, material, motion = random_scene(tools=0)
    with pytest.raises(RPGError, match=r"material of shape \(1, 40, 3\) and torch.float32"):
        backend.step(particles, material.float(), motion, 0.0)
    with pytest.raises(RPGError, match=r"x of shape \(1, 39, 3\)"):
        backend.step(particles._replace(x=particles.x[:, 1:]), material, motion, 0.0)
    with pytest.raises(RPGError, match="on the CPU alone"):
        NumbaBackend(backend.physics, (), torch.ones(2), torch.ones(2), "cuda")
