"""Objects modelled for the figures: signed distances, meshed by libigl, with media on grids made by the same functions.

`candle`, `mandarin`, `meat` and `croissant` are one file each; `distance` has what they are made of, `mesh` and `grid`
make surfaces and media of them, `scene_parts` makes them ready for Mitsuba. Lengths are mm, y is up, and they stand
about y = 0. `halfspace-sss figures all objects` shows them.
"""
