"""The method of Yue et al. 2014: a triangle mesh that flows, its remeshing, and the surface from Poisson's equation."""
