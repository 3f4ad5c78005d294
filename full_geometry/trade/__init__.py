"""The trade of speed for accuracy, measured: what each way of rendering a scene costs, and how wrong it is.

assessment = trade.assess(scene)                               # each way, on each translucent object
advice = trade.recommend(scene, tolerance=0.05, images=10)     # the cheapest way that is good enough
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from full_geometry.trade.advice import recommend, recommend_flat
    from full_geometry.trade.assessing import assess
    from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade

__all__ = ["Assessment", "ObjectTrade", "TechniqueTrade", "assess", "recommend", "recommend_flat"]

RESULTS = ["Assessment", "ObjectTrade", "TechniqueTrade"]
MODULES = {"results": RESULTS, "assessing": ["assess"], "advice": ["recommend", "recommend_flat"]}
__getattr__, __dir__ = lazy_names(__name__, MODULES)
