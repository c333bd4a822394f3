# SPDX-License-Identifier: Apache-2.0

"""What the Bayes3D paper claims of its results, and how summaries of our experiments answer."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

Summary = Mapping[str, Any]  # of the JSON of an experiment
FIGURE_ONLY = "figure only"
PARSER, AS_TRAINED = "Bayes3D", "as trained"
VIEWS = 5  # of the mug from which the parser learned it, where it is compared with networks
ORDERS_OF_MAGNITUDE = 100.0  # "orders of magnitude": two of them at least
MOSTLY_RIGHT, MOST_TOO_MANY = 0.9, 0.1  # of the things that there are
SIGNIFICANT = 0.01
LOW_NOISE = ("1 mm, 0.001", "3 mm, 0.01")  # priors clamped at low noise, as noise-ablation calls them
NOISY = ("high", "highest")


class Ours(NamedTuple):
    """What our numbers say of a claim."""

    words: str
    holds: bool
    why_not: str = ""  # where our numbers say why the claim does not hold; else the claim's own `why_not` is told


class Claim(NamedTuple):
    """answer(summary): what ours are; None where the summary lacks the numbers. why_not: what is known of the reason
    where the claim does not hold with ours."""

    claim: str
    where: str  # figure, table or section of the paper
    number: str  # the paper's, or FIGURE_ONLY
    experiment: str
    criterion: str  # what counts as holding
    answer: Callable[[Summary], Ours | None]
    why_not: str


def less_training(summary: Summary) -> Ours | None:
    """How many images a network needs to be as good as the parser, which learns from views (mug-pose), or from no
    image at all (object-type)."""
    sizes = _sizes(summary, AS_TRAINED)
    ours, theirs = (
        sizes.get(PARSER),
        [size for name, own in sizes.items() if not name.startswith(PARSER) for size in own],
    )
    if not ours or not theirs:
        return None
    needed = summary["network_needs"].get(AS_TRAINED)
    said = f"no network of up to {max(theirs):,} images" if needed is None else f"networks from {needed:,} images on"
    views = VIEWS if VIEWS in ours else 0
    told = f"{views} views" if views else "no training images"
    return Ours(f"{told}; as good: {said}", needed is None or needed >= ORDERS_OF_MAGNITUDE * max(1, views))


def pose_beyond_training(summary: Summary) -> Ours | None:
    """Cross-entropies out of distribution: the parser with VIEWS, and the best network of all."""
    worse, told = [], []
    for condition in summary.get("network_needs", {}):
        losses = _losses(summary, condition, "cross_entropy")
        ours, theirs = _of_parser(losses), _of_networks(losses)
        if condition != AS_TRAINED and ours is not None and theirs:
            worse.append(min(theirs) > ours)
            told.append(f"{condition} {ours:.2f} against {min(theirs):.2f}")
    return Ours(f"nats, ours against the best network: {', '.join(told)}", all(worse)) if told else None


def type_beyond_training(summary: Summary) -> Ours | None:
    """The parser's accuracy in and out of distribution, and log losses out of it."""
    condition = "poses off"
    inside, outside = (summary.get(f"{kind}: {PARSER}") for kind in (AS_TRAINED, condition))
    theirs = _of_networks(_losses(summary, condition, "log_loss"))
    if not inside or not outside or not theirs:
        return None
    variances = (one["accuracy"] * (1 - one["accuracy"]) / one["images"] for one in (inside, outside))
    allowed = 2 * sum(variances) ** 0.5
    told = f"right {inside['accuracy']:.1%}, out of distribution {outside['accuracy']:.1%}"
    losses = f"log loss there {outside['log_loss']:.2f}, of the best network {min(theirs):.2f}"
    kept = outside["accuracy"] >= inside["accuracy"] - allowed
    return Ours(f"{told}; {losses}", kept and outside["log_loss"] < min(theirs))


def memory(needed: float, loss: str, summary: Summary) -> Ours | None:
    """The file of the smallest network that is as good as the parser (of the largest one where none is), by the
    parser's files of models; and the same of arrays in memory."""
    ours = summary.get(f"{PARSER}: size")
    suffix = ": size"
    sizes = {name.removesuffix(suffix): value for name, value in summary.items() if name.endswith(suffix)}
    networks = {name: value for name, value in sizes.items() if not name.startswith(PARSER)}
    if not ours or not networks:
        return None
    losses = _losses(summary, AS_TRAINED, loss)
    level = _of_parser(losses)
    good = {name for (name, _), value in losses.items() if level is not None and name in networks and value <= level}
    chosen = min(good or networks, key=lambda name: networks[name]["file_bytes"] * (1 if good else -1))
    theirs = networks[chosen]
    ratio = theirs["file_bytes"] / ours["file_bytes"]
    sign = "" if good else ", which is not as good"
    files = f"{theirs['file_bytes'] / 1e6:.3g} MB ({chosen}{sign}) against {ours['file_bytes'] / 1e3:.3g} KB"
    in_memory = f"in memory {theirs['memory_bytes'] / 1e6:.3g} against {ours['memory_bytes'] / 1e6:.3g} MB"
    of_largest = max(value["file_bytes"] for value in networks.values()) / ours["file_bytes"]
    why_not = "a smaller network than the paper's is as good" if of_largest >= needed else "our files are larger"
    return Ours(f"{files}: {ratio:,.0f} times; {in_memory}", ratio >= needed, why_not)


def noise_priors(summary: Summary) -> Ours | None:
    """In high noise, whether inferring the noise classifies more images right than assuming low noise."""
    told, unsure = [], []
    for level in NOISY:
        inferred = summary.get(f"{level}: inferred")
        for prior in LOW_NOISE:
            clamped = summary.get(f"{level}: {prior}")
            if inferred and clamped:
                told.append(f"{level} noise {inferred['right']:.0%} against {clamped['right']:.0%} ({prior})")
                if (p := clamped["p_inferred_better"]) >= SIGNIFICANT:
                    unsure.append(f"{level} noise, {prior}: p = {p:.2g}")
    words = f"right, inferred against clamped: {', '.join(told)}"
    return Ours(words, not unsure, f"not significant: {'; '.join(unsure)}") if told else None


def scenes_right(models: str, summary: Summary) -> Ours | None:
    """Things of recorded scenes that are told right."""
    own = summary.get(models)
    if not own or not own["things"]:
        return None
    wrong = own["false_objects"] + own["extra_unknown"]
    told = f"{own['right']} of {own['things']} things right in {own['with_truth']} frames, {wrong} too many"
    return Ours(told, own["right"] >= MOSTLY_RIGHT * own["things"] and wrong <= MOST_TOO_MANY * own["things"])


def frame_rate(size: int, paper: float, summary: Summary) -> Ours | None:
    """Frames a second of the slowest object at a size."""
    fps = summary.get(f"fps_{size}")
    return None if fps is None else Ours(f"{fps:.1f} FPS", fps >= paper)


def tracking_error(what: str, unit: str, paper: float, summary: Summary) -> Ours | None:
    """The largest mean error of all objects and sizes, on frames of the model's own renderer, as in the paper."""
    error = summary.get(f"worst_{what}_own")
    if error is None:
        return None
    lost = summary.get("lost_own") or 0
    return Ours(f"{error:.3f} {unit}" + (f", lost in {lost} frames" if lost else ""), error <= paper and not lost)


def tracking_rows(summary: Summary) -> Ours | None:
    """Rows of the tracking table, on frames of the model's own renderer, whose mean errors exceed the paper's."""
    missed = summary.get("not_met")
    if missed is None:
        return None
    worse = [row.removesuffix(" own") for row in missed if row.endswith(" own")]
    return Ours(f"larger: {', '.join(worse)}" if worse else "no larger error in any row", not worse)


def _losses(summary: Summary, condition: str, key: str) -> dict[tuple[str, str], float]:
    """By method and what it was trained on, as the summary names them; '' where that is nothing."""
    found = {}
    for name, value in summary.items():
        if name.startswith(f"{condition}: ") and isinstance(value, dict) and value.get(key) is not None:
            own = name.removeprefix(f"{condition}: ")
            method, _, size = own.rpartition(" ")
            found[(method, size) if size.isdigit() or size == "mesh" else (own, "")] = value[key]
    return found


def _sizes(summary: Summary, condition: str) -> dict[str, list[int]]:
    """What every method was trained on, where that is a number; 0: nothing."""
    found: dict[str, list[int]] = {}
    for key in ("cross_entropy", "log_loss"):
        for method, size in _losses(summary, condition, key):
            if size != "mesh":
                found.setdefault(method, []).append(int(size or 0))
    return found


def _of_parser(losses: Mapping[tuple[str, str], float]) -> float | None:
    """With VIEWS, or without any training."""
    return losses.get((PARSER, str(VIEWS)), losses.get((PARSER, "")))


def _of_networks(losses: Mapping[tuple[str, str], float]) -> Sequence[float]:
    return [value for (method, _), value in losses.items() if not method.startswith(PARSER)]


_LESS = "a network needs 100 times as many images as ours has views (where ours has no view: 100), or none is as good"
_FEW = "test images are drawn as the networks' training images are, which the parser has not seen"
_POSE, _TYPE, _NOISE = '"6D Pose Uncertainty"', '"Object Type Uncertainty"', '"Hierarchical Bayesian Inference"'
_TRACKING = "Table I"
_CPU = "the paper's FPS are those of one GPU; ours were measured on {machine}"
_SLOWEST = "the slowest of its objects and ours"
_LARGEST = "the largest mean error of its table and ours, on frames of the model's own renderer; never lost"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "The pose posterior is as good as a network's with substantially less training data",
        f"Fig. 2c, {_POSE}", FIGURE_ONLY, "mug-pose", _LESS, less_training, _FEW,
    ),
    Claim(
        "Out of distribution the network's pose does not generalize, ours does",
        f"Fig. 2c, {_POSE}", FIGURE_ONLY, "mug-pose", "a smaller cross-entropy than every network's in every condition",
        pose_beyond_training, "see the experiment's page",
    ),
    Claim(
        "A network as good at the pose needs far more memory than our models",
        _POSE, "1700 times (27.9 MB, 7 million parameters, against 16 KB)", "mug-pose", "at least 1700 times",
        partial(memory, 1700, "cross_entropy"), "",
    ),
    Claim(
        "The type posterior is as accurate as a network's with much less data",
        f"Fig. 3c, {_TYPE}", FIGURE_ONLY, "object-type", _LESS, less_training, _FEW,
    ),
    Claim(
        "Out of distribution the type posterior does not deteriorate, networks do",
        f"Fig. 3c, {_TYPE}", FIGURE_ONLY, "object-type",
        "no fewer right beyond two standard errors, and a smaller log loss than every network's", type_beyond_training,
        "see the experiment's page",
    ),
    Claim(
        "A network as good at the type needs far more memory than our models",
        _TYPE, "1050 times (12.6 MB, 3.15 million parameters, against 16 KB; the ratio of these is 790)", "object-type",
        "at least 1050 times",
        partial(memory, 1050, "log_loss"), "",
    ),
    Claim(
        "In high noise, assuming low noise misclassifies more objects than priors over the noise",
        f"Fig. 4, {_NOISE}", FIGURE_ONLY, "noise-ablation",
        "more right in high noise than with either clamped low noise, at 1 % (McNemar)", noise_priors,
        "see the experiment's page",
    ),
    Claim(
        "Real single-object and multi-object scenes are parsed robustly, occluded objects included",
        "Fig. 5", FIGURE_ONLY, "real-scenes", "90 % of all things right, at most 10 % too many",
        partial(scenes_right, "meshes"),
        "see the pictures that the experiment draws; a foreign thing that is called by a type counts as wrong",
    ),
    Claim(
        "So they are with models that were learned of each object on its own",
        "Fig. 5", FIGURE_ONLY, "real-scenes", "90 % of all things right, at most 10 % too many",
        partial(scenes_right, "learned"), "one view leaves the hidden side of a model open; the notes say which views",
    ),
    *(
        Claim(
            f"The camera is tracked in real time at {size} x {size} pixels",
            _TRACKING, f"{fps} FPS", "camera-tracking", f"as many FPS, {_SLOWEST}", partial(frame_rate, size, fps),
            _CPU,
        )
        for size, fps in ((25, 103.207), (50, 79.265), (100, 34.615), (200, 14.013))
    ),
    Claim(
        "Tracking is accurate: every object at every size", _TRACKING, "0.002 to 0.650 cm, 0.736 to 3.710 degrees",
        "camera-tracking", "no mean error larger than in the table's row (of positions: than 0.01 cm, if that is more)",
        tracking_rows, "see the experiment's page",
    ),
    Claim(
        "Tracking is accurate: position", _TRACKING, "0.650 cm", "camera-tracking", f"at most that: {_LARGEST}",
        partial(tracking_error, "position_cm", "cm", 0.65), "see the experiment's page",
    ),
    Claim(
        "Tracking is accurate: orientation", _TRACKING, "3.710 degrees", "camera-tracking", f"at most that: {_LARGEST}",
        partial(tracking_error, "orientation_deg", "degrees", 3.71), "see the experiment's page",
    ),
)  # fmt: skip
