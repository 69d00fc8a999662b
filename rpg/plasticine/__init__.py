"""A differentiable soft-body simulator, its ten tasks, and trajectory optimisation (thesis, chapter 2)."""
