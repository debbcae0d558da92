"""How tests compile what they run once."""

from zwidth.arrays.xp import known_options

# In a third of the time, for what runs once or a few times: XLA simplifies and fuses, but does little work on machine
# code, in one piece and by its older emitters. Where both were compared the numbers were the same to the last places.
# That the library's own compiled functions are right at full optimization is seen wherever they are called.
QUICKLY = known_options(
    ("xla_backend_optimization_level", 0),
    ("xla_cpu_use_fusion_emitters", False),
    ("xla_cpu_parallel_codegen_split_count", 1),
)
