from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rpg.errors import NonFiniteError
from rpg.plasticine.losses import WEIGHTS, combine, contact_term, shape_terms
from rpg.plasticine.physics import SHAPES, Shape, Tool
from rpg.plasticine.score import score_mass, soft_iou
from rpg.plasticine.shape_kernels import iou_of_particles, shape_terms_of_particles
from rpg.plasticine.surfaces import signed_distance

GRID = 16
SIZES = {"sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "torus": 2, "chopsticks": 2}


def scattered(x: Tensor, mass: Tensor) -> Tensor:
    """Mass on the nodes, by the definition: every node asks every particle for its weight."""
    node = torch.arange(GRID, dtype=x.dtype)
    away = (x[..., None] * GRID - node).abs()  # (B, N, 3, grid)
    near, far = 0.75 - away**2, 0.5 * (1.5 - away) ** 2
    weight = torch.where(away < 0.5, near, torch.where(away < 1.5, far, 0.0))
    return torch.einsum("n,bni,bnj,bnk->bijk", mass, *weight.unbind(2))


def problem(dtype: torch.dtype, low: float = 0.2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(2, 60, 3, generator=generator, dtype=torch.float64) * 0.4 + low
    mass = torch.rand(60, generator=generator, dtype=torch.float64) + 0.1
    target = torch.rand(GRID, GRID, GRID, generator=generator, dtype=torch.float64) - 0.1
    distance = torch.rand(GRID, GRID, GRID, generator=generator, dtype=torch.float64)
    return x.to(dtype).requires_grad_(), mass.to(dtype), target.to(dtype), distance.to(dtype)


@pytest.mark.parametrize("low", [0.2, 0.0], ids=["inside", "at the wall"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_kernels_compute_the_formula(dtype: torch.dtype, tolerance: float, low: float) -> None:
    x, mass, target, distance = problem(dtype, low)
    formula = shape_terms(scattered(x, mass), target, distance)
    kernels = shape_terms_of_particles(x, mass, target, distance, float(target.abs().sum()))
    weights = torch.tensor([1.0, -2.0], dtype=dtype)
    for a, b in zip(formula, kernels, strict=True):
        torch.testing.assert_close(b, a, rtol=tolerance, atol=0)
        (wanted,) = torch.autograd.grad((a * weights).sum(), x, retain_graph=True)
        (got,) = torch.autograd.grad((b * weights).sum(), x, retain_graph=True)
        torch.testing.assert_close(got, wanted, rtol=0, atol=tolerance * float(wanted.abs().max()))
        assert wanted.abs().max() > 0


def test_only_particles_in_the_domain_have_a_loss() -> None:
    x, mass, target, distance = problem(torch.float64)
    for value in (float("nan"), float("inf"), 7.0):
        bad = x.detach().clone()
        bad[1, 3, 2] = value
        with pytest.raises(NonFiniteError, match="particles reach"):
            shape_terms_of_particles(bad, mass, target, distance, 1.0)
        with pytest.raises(NonFiniteError, match="particles reach"):
            iou_of_particles(bad, mass, target)


@pytest.mark.parametrize("low", [0.2, 0.0], ids=["inside", "at the wall"])
def test_kernels_compute_the_score(low: float) -> None:
    x, mass, target, _ = problem(torch.float64, low)
    wanted = soft_iou(score_mass(x, mass, GRID), target)
    torch.testing.assert_close(iou_of_particles(x, mass, target), wanted)


@pytest.mark.parametrize("shape", list(SHAPES))
def test_distance_grows_at_rate_one_outside_and_is_negative_inside(shape: Shape) -> None:
    tool = Tool(shape, (0.11, 0.04, 0.07)[: SIZES[shape]])
    q = torch.tensor([0.6, 0.5, -0.3, 0.2], dtype=torch.float64)
    pose = torch.cat([torch.tensor([0.5, 0.4, 0.6]), q / q.norm(), torch.tensor([0.1])])[None].double()
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(1, 500, 3, dtype=torch.float64, generator=generator).requires_grad_()
    d = signed_distance(tool, pose, x)
    (slope,) = torch.autograd.grad(d.sum(), x)
    torch.testing.assert_close(slope.norm(dim=-1), torch.ones_like(d), atol=1e-6, rtol=0)
    assert (d > 0).any()
    # Walking by the distance against the slope ends on the surface.
    landed = signed_distance(tool, pose, (x - d[..., None] * slope).detach())
    torch.testing.assert_close(landed, torch.zeros_like(landed), atol=2e-6, rtol=0)


def test_distances_at_known_points() -> None:
    pose = torch.tensor([[0.5, 0.5, 0.5, 1.0, 0.0, 0.0, 0.0, 0.1]], dtype=torch.float64)

    def at(tool: Tool, *point: float) -> float:
        x = torch.tensor([[point]], dtype=torch.float64) + 0.5
        return float(signed_distance(tool, pose, x))

    assert at(Tool("sphere", (0.1,)), 0.3, 0, 0) == pytest.approx(0.2)
    assert at(Tool("capsule", (0.2, 0.05)), 0, 0.3, 0) == pytest.approx(0.15)
    assert at(Tool("capsule", (0.2, 0.05)), 0, 0.08, 0) == pytest.approx(-0.05, abs=1e-6)
    assert at(Tool("box", (0.1, 0.2, 0.3)), 0.05, 0, 0) == pytest.approx(-0.05, abs=1e-6)
    assert at(Tool("cylinder", (0.1, 0.2)), 0.3, 0, 0) == pytest.approx(0.2)
    assert at(Tool("cylinder", (0.1, 0.2)), 0, 0.3, 0) == pytest.approx(0.1)
    assert at(Tool("torus", (0.2, 0.05)), 0, 0, 0.2) == pytest.approx(-0.05, abs=1e-6)
    # Two sticks that hang from the origin, 0.1 apart in x.
    assert at(Tool("chopsticks", (0.2, 0.02)), 0.05, -0.1, 0) == pytest.approx(-0.02, abs=1e-6)
    assert at(Tool("chopsticks", (0.2, 0.02)), -0.05, 0.1, 0) == pytest.approx(0.08)
    assert at(Tool("chopsticks", (0.2, 0.02)), 0, -0.3, 0) == pytest.approx(0.1118034 - 0.02)


TOOLS = (Tool("sphere", (0.1,)), Tool("capsule", (0.2, 0.05)), Tool("sphere", (0.05,)))


def poses(*places: tuple[float, float, float]) -> Tensor:
    return torch.tensor([[[*p, 1.0, 0.0, 0.0, 0.0, 0.0] for p in places]], dtype=torch.float64)


def test_contact_pulls_the_nearest_particle_alone() -> None:
    x = torch.tensor([[[0.5, 0.5, 0.5], [0.6, 0.5, 0.5]]], dtype=torch.float64, requires_grad=True)
    at = poses((0.9, 0.5, 0.5), (0.0, 0.0, 0.0), (0.5, 0.8, 0.5)).requires_grad_()
    loss = contact_term(x, at, TOOLS, (0, 2), soft=False)
    assert loss.tolist() == pytest.approx([0.2**2 + 0.25**2])
    gx, gp = torch.autograd.grad(loss.sum(), (x, at))
    torch.testing.assert_close(gx[0], torch.tensor([[0, -0.5, 0], [-0.4, 0, 0]]).double(), atol=1e-7, rtol=0)
    assert (gp[0, 1] == 0).all()  # the second tool does not move
    assert gp[0, 0, 0] == pytest.approx(0.4)


def test_contact_is_zero_and_flat_where_tools_touch() -> None:
    x = torch.tensor([[[0.5, 0.5, 0.5]]], dtype=torch.float64, requires_grad=True)
    loss = contact_term(x, poses((0.52, 0.5, 0.5)), TOOLS[:1], (0,), soft=False)
    (gradient,) = torch.autograd.grad(loss.sum(), x)
    assert loss.tolist() == [0]
    assert (gradient == 0).all()


def test_soft_contact_is_between_least_and_greatest_and_pulls_all() -> None:
    x = torch.tensor(
        [[[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [0.55, 0.5, 0.5]]], dtype=torch.float64, requires_grad=True
    )
    at = poses((0.9, 0.5, 0.5))
    soft = contact_term(x, at, TOOLS[:1], (0,), soft=True)
    assert 0.2**2 < soft.item() < 0.3**2
    d = torch.tensor([0.3, 0.2, 0.25]).double()
    w = 1 / (1 + 1e4 * d**2)
    assert soft.item() == pytest.approx(float((w * d).sum() / w.sum()) ** 2)
    (gradient,) = torch.autograd.grad(soft.sum(), x)
    assert (gradient[..., 0] < 0).all()


def test_total_is_the_published_sum_of_the_terms() -> None:
    assert WEIGHTS == {"density": 10.0, "sdf": 10.0, "contact": 1.0}
    loss = combine(*(torch.tensor([v]) for v in (1.0, 0.2, 0.03)))
    assert float(loss.total) == pytest.approx(12.03)
