"""Find where model and data disagree, name the missing effect, add it, and prove that the gap shrank.

:func:`estimator.discrepancy.search.explain` works on any :class:`Subject`: something that can make its problem with
given effects in the model. The steps are separate modules: :mod:`~estimator.discrepancy.gap` says where,
:mod:`~estimator.discrepancy.score` ranks what, :mod:`~estimator.discrepancy.false_alarm` keeps the rate of false names
after the search over the whole library, :mod:`~estimator.discrepancy.search` adds, steps back and proves.
"""
