"""A normalizing flow inside patches of a surface: trained by zuko, evaluated in Dr.Jit, with exact densities."""
