"""What the paper claims, as data, and the table of what results say to it.

Every threshold is ours; the paper gives none but the figures named in `where`. What results cannot test is in `UNTESTED`.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rtc_mjx import over_seeds, results
from rtc_mjx.results import Record
from rtc_mjx.verdicts import LEAST_SEEDS, NOT_TESTED, Claim, bits, constant, gained, lost, metric, null, row

GOALS, DRIVING = ("double_goal",), ("intersection", "womd")
V_A, V_B = "section V-A", "section V-B"
KL_AS_WRITTEN = "rtc_c,losses.kl-direction=prior_posterior"
KINDS = {"c": "continuous types", "d": "discrete types"}
STILL_LUCK = "types still carry luck; what RTC changes is that the policy no longer acts on it, as in the exact model (docs/paper_notes.md)"
LESS_LUCK = "types still carry luck, and the policy still acts on part of it (collisions by source of types)"
FEW_BITS = "eight discrete types hold three bits, so little luck: the naive hierarchy hardly suffers from it"
DIVERGENCES = "not known; what two groups of experts differ by, and seeds among themselves, stands in table.md"
LIVES_BY_LUCK = "RTC's agents collide more often under types of another episode than under their own (docs/learning.md)"
LITTLE_LUCK = "eight discrete types hold little luck: what those of another episode cost stands in type_shift.md"


def double_goal(kind: str) -> tuple[Claim, ...]:
    """Claims on the double goal about methods with one kind of types."""
    rtc, naive, info = f"rtc_{kind}", f"naive_hierarchy_{kind}", f"info_mgail_{kind}"
    whole, other = metric("return", naive, "paired"), metric("return", rtc, "paired")
    few = "not known" if kind == "c" else FEW_BITS
    return (
        Claim(
            GOALS, "RTC returns at least what MGAIL does", V_A, metric("return", rtc), ">=", metric("return", "mgail"),
            why="MGAIL gathers more than the expert does, by giving a mode up; a full copy does not surpass its expert",
        ),
        Claim(
            GOALS, "MGAIL drops modes, RTC does not", V_A, metric("jsd_goal", rtc), "<=", 0.25 * metric("jsd_goal", "mgail"),
            "a quarter of MGAIL's JSD",
        ),
        Claim(
            GOALS, "RTC reaches the goals as often as experts do", V_A, metric("jsd_goal", rtc), "<=", constant(0.005, "bit"),
            "a JSD of 0.005 bit", "in some seeds the policy overrules its type late in the training",
        ),
        Claim(
            GOALS, "RTC covers the goals at least as well as InfoMGAIL", V_A, metric("jsd_goal", rtc), "<=", metric("jsd_goal", info),
        ),
        Claim(GOALS, "RTC returns at least what InfoMGAIL does", V_A, metric("return", rtc), ">=", metric("return", info)),
        Claim(
            GOALS, "the naive hierarchy suffers from conditional type shift (types of another episode)", V_A,
            metric("return", naive, "shuffled"), "<=", 0.5 * whole, "half of its paired return", few,
        ),
        Claim(
            GOALS, "the naive hierarchy suffers under the prior (conditional and marginal shift)", V_A,
            metric("return", naive), "<=", 0.5 * whole, "half of its paired return", few,
        ),
        Claim(
            GOALS, "RTC does not suffer from conditional type shift", V_A,
            metric("return", rtc, "shuffled"), ">=", 0.9 * other, "0.9 of its paired return",
        ),
        Claim(
            GOALS, "RTC does not suffer under the prior (conditional and marginal shift)", V_A,
            metric("return", rtc), ">=", 0.9 * other, "0.9 of its paired return",
        ),
        Claim(
            GOALS, "RTC removes most of the conditional shift (paired less shuffled return)", "sections III, V-A",
            lost("return", naive), ">=", 5 * lost("return", rtc), "a fifth of the naive hierarchy's", few,
        ),
        Claim(
            GOALS, "RTC's types hold no luck", "sections III, IV", bits(rtc), "<=", null(rtc) + 0.1 * bits(naive),
            "the permutation null and a tenth of the naive hierarchy's bits", STILL_LUCK,
        ),
    )  # fmt: skip


def driving(kind: str) -> tuple[Claim, ...]:
    """Claims on driving about methods with one kind of types."""
    rtc, naive, info = f"rtc_{kind}", f"naive_hierarchy_{kind}", f"info_mgail_{kind}"
    hits, by_luck = "collision_rate", LIVES_BY_LUCK if kind == "c" else LITTLE_LUCK
    against = {"InfoMGAIL": info, "Symphony": "symphony"}
    return (
        Claim(DRIVING, "RTC collides less than MGAIL", V_B, metric(hits, rtc), "<=", metric(hits, "mgail"), why=by_luck),
        Claim(
            DRIVING, "the naive hierarchy collides far more often than RTC", f"{V_B}: eight times", metric(hits, naive), ">=",
            4 * metric(hits, rtc), "four times", by_luck,
        ),
        Claim(
            DRIVING, "the naive hierarchy suffers from conditional type shift (types of another episode)", V_B,
            metric(hits, naive, "shuffled"), ">=", 2 * metric(hits, naive, "paired"), "twice its paired collisions",
        ),
        Claim(
            DRIVING, "the naive hierarchy suffers under the prior (conditional and marginal shift)", V_B,
            metric(hits, naive), ">=", 2 * metric(hits, naive, "paired"), "twice its paired collisions",
        ),
        Claim(
            DRIVING, "RTC removes most of the conditional shift (shuffled less paired collisions)", "sections III, V-B",
            gained(hits, naive), ">=", 5 * gained(hits, rtc), "a fifth of the naive hierarchy's", by_luck,
        ),
        Claim(
            DRIVING, "RTC's types hold no luck", "sections III, IV", bits(rtc), "<=", null(rtc) + 0.1 * bits(naive),
            "the permutation null and a tenth of the naive hierarchy's bits", LESS_LUCK,
        ),
        Claim(DRIVING, "RTC covers what drivers do better than MGAIL", V_B, metric("min_ade", rtc), "<=", 0.9 * metric("min_ade", "mgail"),
              "0.9 of MGAIL's minADE"),
        Claim(DRIVING, "RTC's progress is distributed better than MGAIL's", V_B, metric("progress_jsd", rtc), "<=",
              0.7 * metric("progress_jsd", "mgail"), "0.7 of MGAIL's JSD", DIVERGENCES),
        Claim(DRIVING, "RTC's curvature is distributed at least as well as MGAIL's", V_B, metric("curvature_jsd", rtc), "<=",
              metric("curvature_jsd", "mgail"), why=DIVERGENCES),
        *(Claim(DRIVING, f"RTC collides at most as often as {name}", "abstract, section V-B", metric(hits, rtc), "<=", metric(hits, of),
                why=by_luck) for name, of in against.items()),
        *(Claim(DRIVING, f"RTC's progress is distributed better than {name}'s", "abstract, section V-B", metric("progress_jsd", rtc), "<=",
                metric("progress_jsd", of), why=DIVERGENCES) for name, of in against.items()),
    )  # fmt: skip


CLAIMS = (
    Claim(GOALS, "MGAIL returns more than BC", V_A, metric("return", "mgail"), ">=", metric("return", "bc")),
    *(replace(claim, text=f"{claim.text} ({types})") for kind, types in KINDS.items() for claim in double_goal(kind)),
    Claim(
        GOALS, "with KL[p‖e], as written, the prior fits the encoder's marginal: no marginal shift", "section IV, eq. 3",
        metric("return", KL_AS_WRITTEN), ">=", 0.95 * metric("return", KL_AS_WRITTEN, "shuffled"), "0.95 of its shuffled return",
        "its minimiser is the encoders' normalised geometric mean, not their marginal (docs/paper_notes.md)",
    ),
    *(replace(claim, text=f"{claim.text} ({types})") for kind, types in KINDS.items() for claim in driving(kind)),
)  # fmt: skip
COLUMNS = ("claim", "in the paper", "our threshold", "measured: mean over seeds [95 % interval]", "p", "reproduced", "why not")
CAPTION = (
    "A margin above 0 is what the claim says, seed by seed, paired by the seed's number. Yes or no: the 95 % t interval of the mean margin "
    "leaves out 0, and the two-sided sign-flip test has p < 0.05, where it can: that takes "
    f"{over_seeds.DECIDING} seeds. A tie is neither. No verdict on fewer than {LEAST_SEEDS} seeds. Thresholds are ours, not the paper's. "
    "Intervals of figures are over seeds too."
)
UNTESTED = (
    "Not tested by results: Theorem 1 (section III) is about exact distributions, `python -m rtc_mjx.theory` and `tests/test_theory.py` "
    "test it; what minimises eq. 3's KL has a closed form, `tests/test_distributions.py` tests it. A claim about a variation of RTC needs "
    "`--ablations`."
)


def table(scene: str, held: Mapping[str, Record]) -> str:
    """The paper's claims on a scene with what was measured, as Markdown; empty where none is about the scene.

    Where all of them compare methods of which some was not run, as beside one method alone, a sentence that says so.
    """
    about = [claim for claim in CLAIMS if scene in claim.scenes]
    if not about:
        return ""
    if results.finished(held) == held and not any(claim.names <= set(held) for claim in about):
        told = f"The paper's {len(about)} claims on {scene} compare methods that are not all among these results"
        return f"{told}: `python -m rtc_mjx.study --scene {scene}` runs them.\n"
    return results.markdown([COLUMNS, *(row(claim, held) for claim in about)], left=len(COLUMNS)) + f"\n{CAPTION}\n\n{UNTESTED}\n"


def everywhere(folder: Path) -> str:
    """The claims of all results in folders beside each other, results/*/*.json, as one table; empty where there are none.

    A claim that is tested in one folder is left out of others of the scene that do not test it, such as those of a few variations.
    """
    parts: list[tuple[str, str, list[str]]] = []
    for place in sorted(folder.iterdir()) if folder.is_dir() else []:
        held = results.read(place) if place.is_dir() else {}
        scene = next(iter(held.values()))["scene"] if held else ""
        parts += [(scene, claim.text, [place.name, *row(claim, held)]) for claim in CLAIMS if scene in claim.scenes]
    tested = {(scene, text) for scene, text, cells in parts if NOT_TESTED not in cells}
    told = [cells for scene, text, cells in parts if NOT_TESTED not in cells or (scene, text) not in tested]
    head = ("results", *COLUMNS)
    return results.markdown([head, *told], left=len(head)) + f"\n{CAPTION}\n\n{UNTESTED}\n" if told else ""
