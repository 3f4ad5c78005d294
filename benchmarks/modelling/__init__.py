"""Objects modelled for the figures: signed distances, meshed by libigl, with media on grids made by the same functions.

`candle` and `varying` have their shapes and tissues; `objects` makes their media and gets them ready for Mitsuba.
Lengths are mm, y is up, and they stand about y = 0. Figures 1 and 7 show them.
"""
