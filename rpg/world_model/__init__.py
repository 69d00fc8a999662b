"""Self-supervised latent dynamics with reward and value heads."""

from rpg.world_model.config import WorldModelConfig
from rpg.world_model.inputs import ObservationInput
from rpg.world_model.model import WorldModel

__all__ = ["ObservationInput", "WorldModel", "WorldModelConfig"]
