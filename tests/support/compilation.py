"""How the tests compile where rounding is what they measure."""

AS_SHIPPED = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
