"""How tests compile what they run once."""

# XLA at its full optimization, but with its older emitters of machine code: of a derivative's thousands of operations
# a fifth to a half sooner. Where both were compared the numbers were the same to the last places.
SOON = {"xla_cpu_use_fusion_emitters": False}

# In a third of the time, for what runs once or a few times: XLA simplifies and fuses, but does little work on machine
# code. That the library's own compiled functions are right at full optimization is seen wherever they are called.
QUICKLY = {"xla_backend_optimization_level": 0, **SOON}
