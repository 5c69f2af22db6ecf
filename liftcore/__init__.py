"""liftcore: the rasterizer and the solver of splatlift.

Lifting solves ``A X = B``: ``A`` [rays x splats] holds the alpha-compositing weights of a trained splat
scene, ``B`` [rays x channels] the 2D features of its photos, ``X`` [splats x channels] the lifted features
(*Splat Feature Solver*, Eq. 3). Nothing is imported here, so that light processes stay light.
"""

__version__ = "0.3.0"
