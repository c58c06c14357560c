"""State representation learning for model-free reinforcement learning from pixels, in JAX."""

__version__ = "0.1.0"
