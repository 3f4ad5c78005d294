"""Figures 3, 7 and 8, Table 1 and the methods of others in them: the paper's own, Deng et al. 2022, TG et al. 2023."""
