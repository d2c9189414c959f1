"""Runs at another operating point: another loop, whose parameters are others.

A campaign may walk operating points (`daq.operating`); an analysis is of one. Unless the campaign
was narrowed to one (`Campaign.at_operating_point`), that is the point with the most forced runs.
"""

from collections import Counter

from identify.quality.findings import finding
from identify.record import Campaign
from identify.results import QualityFlag


def elsewhere(campaign: Campaign) -> list[QualityFlag]:
    """`other_operating_point` for every run that is not at the analysed point."""
    points = Counter(r.operating_point for r in campaign.runs if r.kind == "forced")
    if len(points) < 2:
        return []
    chosen = points.most_common(1)[0][0]
    return [
        finding(
            r.name,
            "other_operating_point",
            "excluded",
            f"at operating point {r.operating_point!r}; analysed is {chosen!r}, which has most "
            "forced runs: narrow the campaign to a point to analyse another",
        )
        for r in campaign.runs
        if r.operating_point != chosen
    ]
