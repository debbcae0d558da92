"""The dominant pole of the rigid loop, i.e. the pole of largest modulus, computed with a certificate.

The module `spectral_radius` contains the public functions. `arrays` chooses between two methods for many walls:
`search` finds and certifies the pole of each wall separately; `grid` divides a grid of walls into cells and computes
one power series (`series`) per cell. Both methods certify their results by counting poles (`pole_count`). The module
`compiled` computes the poles of walls that are given as JAX arrays. `steps` contains the Newton and Halley steps.
"""
