"""How tests compile what they run once."""

# XLA at its full optimization, but with its older emitters of machine code: of a derivative's thousands of operations
# a fifth to a half sooner. Where both were compared the numbers were the same to the last places.
SOON = {"xla_cpu_use_fusion_emitters": False}
