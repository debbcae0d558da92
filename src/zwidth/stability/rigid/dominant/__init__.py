"""The dominant pole of the rigid loop, i.e. the pole of largest modulus, computed with a certificate.

`spectral_radius` has the public functions. `arrays` chooses between two methods for many walls: `search` finds and
certifies the pole of each wall, `grid` computes one power series (`series`) per cell of a grid of walls. `pole_count`
is the certificate of both, `steps` has the Newton and Halley steps.
"""
