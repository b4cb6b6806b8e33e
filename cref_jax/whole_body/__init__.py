"""The whole robot in MuJoCo C on real boxes, without JAX."""
