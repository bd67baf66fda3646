"""mems6dof: particle tracking of a microsystem in three dimensions and six degrees of freedom."""

__version__ = "0.1.0"
