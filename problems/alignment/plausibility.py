"""Units and component orders of a campaign, checked against physics."""

from __future__ import annotations

from problems.alignment.campaign import Campaign


def check_plausibility(campaign: Campaign) -> None:
    """Placeholder until the next commit."""
