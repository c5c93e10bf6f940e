"""Models of the scene: dense clouds fused along a trajectory, and temperatures painted on them."""
