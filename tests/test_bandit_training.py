"""Fig. 3.4: exact densities, unbiased gradients, independent seeds, and training that can fail."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from rpg.bandit import BanditConfig, BanditResult, TanhNormalMixture, train_gaussian, train_rpg
from rpg.envs.bandit import bandit_reward
from rpg.errors import NonFiniteError, RPGError

# Faster annealing and larger steps than the figure, so that a second of training shows the outcome.
SHORT = BanditConfig(
    steps=1000, log_every=500, batch=128, decay=0.996, learning_rate=4e-3, gaussian_learning_rate=0.012
)


def cells(count: int = 400_000) -> Tensor:
    """Midpoints of equal cells over (-1, 1)."""
    return (torch.arange(count, dtype=torch.float64) + 0.5) * (2.0 / count) - 1.0


def mixture() -> TanhNormalMixture:
    weight = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    mean = torch.tensor([-0.7, 0.1, 1.2], dtype=torch.float64)
    return TanhNormalMixture(weight, mean, torch.tensor([-3.0, -0.5, -1.0], dtype=torch.float64))


def test_density_is_one_and_agrees_with_mass_and_mean_reward() -> None:
    action, policy = cells(), mixture()
    density = policy.density(action)
    width = 2.0 / len(action)
    assert density.min() >= 0.0
    assert density.sum().item() * width == pytest.approx(1.0, abs=1e-6)
    inside = (action > -0.7) & (action < -0.4)
    assert policy.mass(-0.7, -0.4).item() == pytest.approx(density[inside].sum().item() * width, abs=1e-5)
    expected = (density * bandit_reward(action)).sum().item() * width
    assert policy.mean_reward().item() == pytest.approx(expected, abs=1e-3)


def test_density_is_that_of_the_samples() -> None:
    policy = mixture()
    generator = torch.Generator().manual_seed(0)
    z = policy.weight.multinomial(200_000, replacement=True, generator=generator)
    noise = torch.randn(200_000, generator=generator, dtype=torch.float64)
    action = (policy.mean[z] + policy.log_std[z].exp() * noise).tanh()
    for low, high in ((-0.7, -0.5), (-0.5, 0.5), (0.5, 0.9)):
        share = ((action > low) & (action < high)).double().mean().item()
        assert policy.mass(low, high).item() == pytest.approx(share, abs=0.005)


def test_wide_gaussian_is_drawn_to_the_local_optimum() -> None:
    """The trap: from mean 0, std e the expected reward rises to the right, where the lower mode is.

    The derivative of the reward alone (pathwise) makes it 17 times steeper: it misses the jump.
    """
    action = cells()

    def expected_reward(mean: float) -> float:
        policy = TanhNormalMixture(*(torch.tensor([x], dtype=torch.float64) for x in (1.0, mean, 1.0)))
        return (policy.density(action) * bandit_reward(action)).sum().item() * 2.0 / len(action)

    slope = (expected_reward(0.1) - expected_reward(-0.1)) / 0.2
    assert slope == pytest.approx(0.0040, abs=2e-4)

    mean = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    one = torch.ones(1, dtype=torch.float64)
    TanhNormalMixture(one, mean, one).mean_reward().backward()
    assert mean.grad is not None
    assert mean.grad.item() == pytest.approx(0.0688, abs=1e-3)


def test_rpg_finds_the_global_mode_where_the_gaussian_does_not() -> None:
    rpg = train_rpg(SHORT, seeds=(0, 1))
    assert rpg.steps == (0, 500, 1000)
    assert rpg.policy.mean.shape == (2, 3, SHORT.latents)
    assert rpg.mass_global.shape == rpg.mean_reward.shape == (2, 3)
    assert (rpg.mass_global[:, 0] < 0.2).all()
    assert (rpg.mass_global[:, -1] > 0.8).all()
    assert (rpg.mean_reward[:, -1] > 0.8).all()

    gaussian = train_gaussian(SHORT, seeds=(0, 1))
    assert (gaussian.policy.mean[:, -1] > 0.5).all()
    assert (gaussian.mass_global[:, -1] < gaussian.mass_global[:, 1] / 2).all()
    assert not gaussian.success.any()


@pytest.mark.parametrize("gradient", ["score", "pathwise"])
def test_seeds_do_not_depend_on_their_company(gradient: str) -> None:
    config = BanditConfig(steps=40, batch=64, gradient=gradient)  # type: ignore[arg-type]
    for train in (train_rpg, train_gaussian):
        together, alone = train(config, seeds=(5, 3, 9)), train(config, seeds=(3,))
        for field, own in zip(together.policy, alone.policy, strict=True):
            torch.testing.assert_close(field[1], own[0], rtol=0, atol=1e-6)
        assert not torch.equal(together.policy.mean[0], together.policy.mean[1])


def test_equal_arguments_give_equal_results() -> None:
    config = BanditConfig(steps=30, batch=64, full_bound=True)
    first, second = (train_rpg(config, seeds=(0, 1)) for _ in range(2))
    for a, b in zip(first.policy, second.policy, strict=True):
        assert torch.equal(a, b)


def test_success_needs_nine_tenths_at_the_end() -> None:
    mass = np.array([[0.1, 0.91], [0.95, 0.89]])
    result = BanditResult((0, 1), (0, 1), mixture(), np.zeros((2, 2)), mass)
    assert result.success.tolist() == [True, False]


def test_bad_settings_and_divergence_are_named() -> None:
    with pytest.raises(RPGError, match="gradient 'reinforce' is unknown"):
        BanditConfig(gradient="reinforce")  # type: ignore[arg-type]
    with pytest.raises(RPGError, match="latents 0"):
        BanditConfig(latents=0)
    with pytest.raises(RPGError, match=r"decay 1\.5"):
        BanditConfig(decay=1.5)
    with pytest.raises(RPGError, match="no seeds"):
        train_rpg(BanditConfig(), seeds=())
    with pytest.raises(NonFiniteError, match="seed 7 is not finite after"):
        train_rpg(BanditConfig(steps=20, log_every=5, learning_rate=1e30), seeds=(7,))


def test_script_writes_and_redraws_the_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(__file__).parents[1] / "scripts" / "figure_bandit.py"
    spec = importlib.util.spec_from_file_location("figure_bandit", path)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    assert script.main(["--seeds", "2", "--steps", "10", "--out", str(tmp_path)]) == 0
    rows = (tmp_path / "final.csv").read_text().splitlines()
    assert rows[0] == "method,seed,mean_reward,mass_global,success"
    assert [row.split(",")[:2] for row in rows[1:]] == [
        ["rpg", "0"],
        ["rpg", "1"],
        ["gaussian", "0"],
        ["gaussian", "1"],
    ]
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["seeds"] == [0, 1]
    assert record["published_settings"]["of"] == 2

    picture = (tmp_path / "figure_3_4.png").read_bytes()
    (tmp_path / "figure_3_4.png").unlink()
    assert script.main(["--redraw", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "figure_3_4.png").read_bytes() == picture
    with pytest.raises(SystemExit, match="2"):
        script.main(["--redraw", "--out", str(tmp_path / "nowhere")])
    assert "policy.csv is missing; run the script without --redraw first" in capsys.readouterr().err
