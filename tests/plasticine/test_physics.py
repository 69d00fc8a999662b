"""What the simulated material must do whatever the discretisation: conserve, rest, bounce, yield, slide, let go."""

from __future__ import annotations

import math

import pytest
import torch
from dough import CELL, DT, STICKY, idle, moving, plate, repeated, run, scene, sphere, strained
from torch import Tensor

from rpg.plasticine.scene import Scene
from rpg.plasticine.state import State

STEP_S = 19 * DT
GRAVITY = 30.0
NEVER = 1e6  # a yield stress
WEIGHTLESS = [0.0, 0.0, 0.0]


def momentum(scene: Scene, state: State) -> Tensor:
    """(3,)."""
    return (scene.mass[:, None] * state.particles.v[0]).double().sum(0)


def angular_momentum(scene: Scene, state: State) -> Tensor:
    """(3,), of the particles' paths and of their own spins; the grid's inertia about a particle is dx^2 / 4."""
    x, v, C, _ = (t[0].double() for t in state.particles)
    spin = torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], -1)
    each = torch.linalg.cross(x, v) + scene.physics.dx**2 / 4 * spin
    return (scene.mass.double()[:, None] * each).sum(0)


def energy(scene: Scene, state: State) -> float:
    """Kinetic with that of the affine motion, potential, and elastic (fixed corotated)."""
    x, v, C, b = (t[0].double() for t in state.particles)
    mass = scene.mass.double()
    kinetic = 0.5 * (v * v).sum(-1) + scene.physics.dx**2 / 8 * (C * C).sum((-2, -1))
    height = -x @ torch.tensor(scene.physics.gravity, dtype=torch.float64)
    stretch = torch.linalg.eigvalsh(b[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))).sqrt()
    mu, lam, _ = state.material[0].double().unbind(-1)
    elastic = mu * ((stretch - 1) ** 2).sum(-1) + lam / 2 * (stretch.prod(-1) - 1) ** 2
    return float((mass * (kinetic + height + elastic / scene.density)).sum())


def deviator(b: Tensor) -> Tensor:
    """Norm of the deviator of the Hencky strain, (...), of strains (..., 6)."""
    strain = torch.linalg.eigvalsh(b[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))).log() / 2
    return (strain - strain.mean(-1, keepdim=True)).norm(dim=-1)


def noise(scene: Scene, size: float) -> Tensor:
    return size * torch.randn(
        scene.n_particles, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )


@pytest.mark.parametrize(("dtype", "close"), [("float64", 1e-8), ("float32", 1e-5)])
def test_free_fall_keeps_mass_and_momentum(dtype: str, close: float) -> None:
    """Up to what nodes of less than 1e-12 hold: these are left out."""
    falling = scene(dtype=dtype)
    start = moving(falling.initial_state(), noise(falling, 1.0) + torch.tensor([0.5, 1.0, -0.3]))
    states = idle(falling, 4, start)
    total = float(falling.mass.double().sum())
    weight = total * torch.tensor([0.0, -GRAVITY * STEP_S, 0.0], dtype=torch.float64)
    for steps, state in enumerate(states, 1):
        grid = falling.grid_mass(state).double()
        assert float(grid.sum()) == pytest.approx(total, rel=close)
        wanted = momentum(falling, start) + steps * weight
        torch.testing.assert_close(momentum(falling, state), wanted, rtol=0, atol=close * total)


@pytest.mark.parametrize(("dtype", "close"), [("float64", 1e-8), ("float32", 1e-5)])
def test_angular_momentum_is_kept(dtype: str, close: float) -> None:
    """The affine velocities carry what the transfer would else lose (APIC); stress adds none, being symmetric."""
    body = scene(dtype=dtype, gravity=WEIGHTLESS)
    state = body.initial_state()
    arm = state.particles.x[0].double() - 0.5
    axis = torch.tensor([3.0, -5.0, 8.0], dtype=torch.float64)
    spinning = moving(state, torch.linalg.cross(axis.expand_as(arm), arm) + noise(body, 0.3))
    before = angular_momentum(body, spinning)
    scale = float(body.mass.sum())  # momentum about a lever of 1
    for state in idle(body, 5, spinning):
        torch.testing.assert_close(angular_momentum(body, state), before, rtol=0, atol=close * scale)


def test_without_affine_velocities_angular_momentum_is_lost() -> None:
    """What the test above would not see if its spin were too small."""
    body = scene(gravity=WEIGHTLESS)
    state = body.initial_state()
    arm = state.particles.x[0] - 0.5
    state = moving(state, torch.linalg.cross(arm.new_tensor([[3.0, -5.0, 8.0]]).expand_as(arm), arm))
    before = angular_momentum(body, state).norm()
    for _ in range(5):
        state = idle(body, 1, state)[0]
        state = state._replace(particles=state.particles._replace(C=torch.zeros_like(state.particles.C)))
    assert angular_momentum(body, state).norm() < 0.99 * before


def test_resting_block_stays() -> None:
    """Its lowest particles stand in the layer of nodes that is the floor."""
    height = 0.15
    block = scene(size=(0.2, height, 0.2), centre=(0.5, 2 * CELL + height / 2, 0.5), particles=600)
    start = block.initial_state().particles.x[0]
    last = idle(block, 40)[-1].particles
    x, fallen = last.x[0], 0.5 * GRAVITY * (40 * STEP_S) ** 2
    assert fallen > 10 * CELL
    assert float((x - start).mean(0).norm()) < 0.02 * CELL
    assert float((x - start).norm(dim=-1).max()) < 0.05 * CELL
    assert float(last.v.norm(dim=-1).mean()) < 0.001 * GRAVITY * 40 * STEP_S


@pytest.mark.parametrize("floor", [0.0, 1.5])
def test_a_ball_bounces_and_no_energy_appears(floor: float) -> None:
    ball = scene(
        size=(0.09,), centre=(0.5, 0.25, 0.5), particles=500, yield_stress=NEVER, floor_friction=floor
    )
    start = moving(ball.initial_state(), torch.tensor([0.5, -4.0, 0.0]))
    states = idle(ball, 40, start)
    kinetic = 0.5 * float(ball.mass.sum()) * (0.5**2 + 4.0**2)
    energies = [energy(ball, state) for state in (start, *states)]
    assert max(energies) < energies[0] + 0.01 * kinetic
    fall = [float(state.particles.v[0, :, 1].mean()) for state in states]
    assert min(fall) < -4.0
    assert max(fall) > 1.0  # up again


def test_above_the_yield_stress_the_deviator_returns_and_below_it_nothing_changes() -> None:
    """One substep without motion: the trial strain is the strain itself."""
    body = scene(gravity=WEIGHTLESS, substeps=1, particles=3, yield_stress=50.0)
    state = body.initial_state()
    limit = 50.0 / float(2 * state.material[0, 0, 0])
    turn = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )[0]
    direction = torch.tensor([1.0, -0.5, -0.5], dtype=torch.float64) / math.sqrt(1.5)
    for size in (0.5, 0.98, 1.02, 3.0):
        strain = size * limit * direction + 0.01  # and some volume
        full = turn @ torch.diag((2 * strain).exp()) @ turn.T
        b = full.flatten()[[0, 1, 2, 4, 5, 8]]
        after = idle(body, 1, strained(state, b))[0].particles.b
        if size < 1:
            torch.testing.assert_close(after, b.expand_as(after), rtol=1e-13, atol=1e-13)
        else:
            # The root is softened by 1e-4, squared.
            assert deviator(after).tolist()[0] == pytest.approx([limit] * 3, rel=1e-4)
        stretch = torch.linalg.eigvalsh(after[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3)))
        assert stretch.prod(-1).log().tolist()[0] == pytest.approx([0.06] * 3, abs=1e-9)


def dented(yield_stress: float) -> tuple[Scene, list[State]]:
    """A sphere presses into a block on a sticky floor and goes up again; nothing falls."""
    height = 0.15
    top = 2 * CELL + height
    tool = sphere(0.5, top + 0.062, 0.5, scale=0.005)
    block = scene(
        tool,
        size=(0.2, height, 0.2),
        centre=(0.5, 2 * CELL + height / 2, 0.5),
        particles=600,
        gravity=WEIGHTLESS,
        floor_friction=STICKY,
        yield_stress=yield_stress,
    )
    down, up = repeated((0.0, -1.0, 0.0), 8), repeated((0.0, 1.0, 0.0), 12)
    return block, run(block, torch.cat([down, up, repeated((0.0, 0.0, 0.0), 10)]))


def dent(block: Scene, states: list[State], step: int) -> float:
    """How much further the topmost particles under the sphere went down than those around it."""
    start = block.initial_state().particles.x[0]
    away = (start[:, [0, 2]] - 0.5).norm(dim=-1)
    top = start[:, 1] > start[:, 1].max() - 0.04
    down = (start - states[step].particles.x[0])[:, 1]
    return float(down[top & (away < 0.04)].mean() - down[top & (away > 0.07)].mean())


def test_yielding_leaves_a_dent_and_elasticity_none() -> None:
    elastic, soft = dented(NEVER), dented(20.0)
    assert dent(*elastic, 7) > 0.25 * CELL
    assert abs(dent(*elastic, -1)) < 0.02 * dent(*elastic, 7)
    assert dent(*soft, -1) > 0.9 * dent(*soft, 7) > 0.25 * CELL


def test_below_the_yield_stress_the_material_is_elastic_to_the_last_digit() -> None:
    elastic, states = dented(NEVER)
    largest = max(float(deviator(state.particles.b).max()) for state in states)
    mu = float(elastic.initial_state().material[0, 0, 0])
    _, above = dented(4 * mu * largest)  # twice what is reached at the ends of steps
    _, below = dented(mu * largest)
    assert torch.equal(above[-1].particles.x, states[-1].particles.x)
    assert not torch.equal(below[-1].particles.x, states[-1].particles.x)


FRICTION = 0.5


def slide(angle: float) -> tuple[float, float]:
    """Acceleration and way of a block on a floor under gravity tilted by ``angle`` degrees."""
    down, along = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    height = 0.1
    block = scene(
        size=(0.2, height, 0.2),
        centre=(0.4, 2 * CELL + height / 2, 0.5),
        particles=500,
        gravity=[GRAVITY * along, -GRAVITY * down, 0.0],
        floor_friction=FRICTION,
        yield_stress=NEVER,
    )
    states = idle(block, 30)
    speeds = [float(state.particles.v[0, :, 0].mean()) for state in states]
    way = float((states[-1].particles.x - block.initial_state().particles.x)[0, :, 0].mean())
    return (speeds[29] - speeds[9]) / (20 * STEP_S), way


def test_friction_angle() -> None:
    """Coulomb's friction on the floor's nodes: the block sticks below atan(0.5) = 26.6 degrees and slides above."""
    for angle in (35.0, 45.0):
        radians = math.radians(angle)
        wanted = GRAVITY * (math.sin(radians) - FRICTION * math.cos(radians))
        assert slide(angle)[0] == pytest.approx(wanted, rel=0.03)
    assert slide(15.0)[1] < 0.02 * CELL
    assert slide(35.0)[1] > 1.0 * CELL


@pytest.mark.parametrize("softness", [0.0, 666.0])
def test_a_tool_that_leaves_takes_nothing_along(softness: float) -> None:
    """A sphere that stands a third of a cell deep in a block at rest."""
    tool = sphere(0.5, 0.61, 0.5, radius=0.06)
    block = scene(tool, centre=(0.5, 0.485, 0.5), gravity=WEIGHTLESS)  # its top is at 0.56
    away = run(block, repeated((0.2, 1.0, -0.2), 3), softness=softness)[-1].particles
    assert float(away.v.abs().max()) < 1e-12
    pressed = run(block, repeated((0.0, -1.0, 0.0), 1), softness=softness)[-1].particles
    assert float(pressed.v[0, :, 1].mean()) < -0.01


@pytest.mark.parametrize(
    ("gap", "softness", "reached"),
    [
        (0.05, 666.0, True), (0.20, 666.0, True), (0.22, 666.0, True), (0.2225, 666.0, False), (0.4, 666.0, False),
        (0.01, 0.0, False), (-0.01, 0.0, True), (0.4, 333.0, True), (0.45, 333.0, False),
    ],
)  # fmt: skip
def test_soft_contact_reaches_to_a_tenth_of_its_strength(gap: float, softness: float, reached: bool) -> None:
    """ln(10) / 666 is 0.2213 cells of 1/64. A plate comes down on the topmost node of a single particle."""
    node, speed = 33 / 64, 5.0
    half = 0.1
    tool = plate(0.5, node + gap / 64 + half, 0.5, half=(half,) * 3, scale=1e-3)
    block = scene(tool, size=(1e-3,) * 3, particles=1, grid=64, dt=1e-4, substeps=1, gravity=WEIGHTLESS)
    before = block.initial_state().particles.x[0, 0] * 64
    after = run(block, repeated((0.0, -0.5, 0.0), 1), softness=softness)[0].particles.v[0, 0]
    if not reached:
        assert after.abs().max() == 0
        return
    weight = 0.5 * (float(before[1]) - math.floor(float(before[1]) - 0.5) - 0.5) ** 2
    strength = min(1.0, math.exp(-softness * gap / 64))
    assert float(after[1]) == pytest.approx(-speed * strength * weight, rel=1e-4)
