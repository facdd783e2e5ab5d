"""The simplified model of Igl et al., section III, exact: one step, tables of probabilities, no sampling.

`tables` is what can be read off tables, `solutions` the paper's two ways to give behaviour types, `theorem` its Theorem 1 put to
random instances, `learning` the tabular agent under the naive and the RTC objective, `drawing` the figures.
`python -m rtc_mjx.theory` tells it all.
"""
