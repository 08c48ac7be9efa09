"""The verdict in words: one sentence, or lines for who reads them one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from magtensor.accuracy import figure

ERRORS = {"total_field_rms_nT": ("total field", "nT"), "tensor_rms_nT_per_m": ("tensor", "nT/m")}
WORSE = 1.1  # times another error: clearly more
OVERFITTED = 3.0  # the error on blocks that were not seen, over that of the fit
LITTLE = 0.25  # of the variance beyond that of held-out blocks
DISAGREES = 3.0  # times the error on held-out blocks
UNUSED = 0.02  # of the samples: more than a few spikes


@dataclass(frozen=True)
class Told:
    """What a verdict says.

    Attributes:
        head: the outcome, with its errors.
        unexplained: what makes it so, in words.
        noted: what was noted of the rest beside that.
        beside: what the verification survey, the attitude and the calibration have to say.
    """

    head: str
    unexplained: Sequence[str] = ()
    noted: Sequence[str] = ()
    beside: Sequence[str] = ()

    @property
    def groups(self) -> dict[str, list[str]]:
        """What goes under one heading each; headings without anything are left out."""
        both = {"Unexplained": [*self.unexplained], "Noted": [*self.noted, *self.beside]}
        return {heading: items for heading, items in both.items() if items}


def sentence(outcome: Mapping[str, Any]) -> str:
    """The verdict in one sentence."""
    said = told(outcome)
    label = "unexplained" if said.unexplained else "noted"
    left = [*said.unexplained, *said.noted]
    return f"{'; '.join([said.head, *([f'{label}: ' + '; '.join(left)] if left else []), *said.beside])}."


def lines(outcome: Mapping[str, Any]) -> list[str]:
    """The same in lines: the outcome, then one for all that is unexplained and one for all that was noted."""
    said = told(outcome)
    return [f"{said.head}.", *_listed(said.groups)]


def lines_of_the_rest(unexplained: Mapping[str, Any]) -> list[str]:
    """The `unexplained` block in lines."""
    found, notes = _left(unexplained)
    if unexplained["present"]:
        return _listed(Told("", found, notes).groups)
    return [*found[:1], *_listed(Told("", noted=[*found[1:], *notes]).groups)]


def _listed(groups: Mapping[str, Sequence[str]]) -> list[str]:
    return [line for heading, items in groups.items() for line in (f"{heading}:", *(f"  - {item}" for item in items))]


def told(outcome: Mapping[str, Any]) -> Told:
    """What a verdict says, in its parts."""
    where, before, after = _judged(outcome)
    if after is None:
        refined = "The tensor was refined; its error cannot be told without a tensor that is known"
        return Told(refined if outcome["declared"] else "Nothing was calibrated")
    figures = _figures(before, after)
    floor = outcome["noise_floor_nT"]
    noise = f"; sensor noise {_figure(floor)} nT" if floor is not None else ""
    errors = f"{figures} {where}{noise}" if figures else f"no error figure can be given{noise}"
    model = f"the {' and '.join(outcome['declared'])} model" if outcome["declared"] else "no model"
    adopted = _named([a for a in outcome["adopted"] if a.get("by") != "person"])
    by_hand = _named([a for a in outcome["adopted"] if a.get("by") == "person"])
    left = outcome["unexplained"]
    if adopted:
        falls, held_out = _falls(before, after), outcome["error"].get("held_out") or {}
        shown_there = bool(held_out.get("after")) and _falls(held_out["before"], held_out["after"])
        absent = not _clearly_worse(before, after) and not _clearly_worse(held_out.get("after"), after, DISAGREES)
        verify = outcome["error"].get("verify") or {}
        beyond = bool(verify.get("extrapolated") or verify.get("not_on_this_survey"))
        if not falls and shown_there and (absent or beyond):
            falls = True
            shown = _figures(held_out["before"], held_out["after"])
            errors = f"{shown} on held-out blocks{noise}; the errors {where} do not show it: {figures}"
        none = f"No error falls{f' {where}' if shown_there else ''}, but the residual looks like"
        head = "The residual was traced to" if falls else none
        head += f" {', '.join(adopted)}"
        head += f"; adopted by hand: {', '.join(by_hand)}" if by_hand else ""
    elif by_hand:
        head = f"Adopted by hand: {', '.join(by_hand)}"
    elif left["present"] is None:
        head = f"Calibrated with {model}"
    elif left["present"]:
        head = f"Calibrated with {model}; a residual remains that no known effect explains"
    else:
        head = f"Calibrated with {model}; what is left looks like noise and asks for no other effect"
    found, notes = _left(left)
    late, doubt = (outcome.get(part, {}).get("description", "") for part in ("attitude", "calibration"))
    beside = [*_disagreement(outcome), *_not_in_use(outcome), *filter(None, (late, doubt))]
    if left["present"] is None:
        return Told(f"{head}: {errors}", beside=beside)
    if left["present"]:
        return Told(f"{head}: {errors}", found, notes, beside)
    return Told(f"{head}: {errors}", noted=[*found, *notes][1:], beside=beside)  # the first says that it is noise


def _left(unexplained: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """What makes something unexplained, and what was noted beside it; of a verdict that tells them in one string, as
    all did once, nothing is beside."""
    if "findings" in unexplained:
        return list(unexplained["findings"]), list(unexplained["notes"])
    return [words for words in str(unexplained["description"] or "").split("; ") if words], []


def _figures(before: dict[str, Any] | None, after: dict[str, Any]) -> str:
    """The errors before and after, in words."""
    return ", ".join(
        f"{name} {_change(before, after, key)} {unit} rms" for key, (name, unit) in ERRORS.items() if after.get(key)
    )


def _falls(before: dict[str, Any] | None, after: dict[str, Any] | None) -> bool:
    """Whether some error falls, or none is known that could."""
    known = [key for key in ERRORS if _of_all(before or {}, key)]
    return not known or any(_of_all(after or {}, key) <= _of_all(before or {}, key) for key in known)


def _clearly_worse(before: dict[str, Any] | None, after: dict[str, Any], times: float = WORSE) -> bool:
    return any(_of_all(after, key) > times * _of_all(before or {}, key) > 0.0 for key in ERRORS)


def _named(adopted: Sequence[Mapping[str, Any]]) -> list[str]:
    """The error models, with the channel of those that follow any, and how often where more than once."""
    names = [_with_its_channel(a) for a in adopted]
    return [f"{count} x {name}" if count > 1 else name for name, count in Counter(names).items()]


def _with_its_channel(a: Mapping[str, Any]) -> str:
    name, settings = str(a["error_model"]), a.get("settings", {})
    channel, others = settings.get("channel"), a.get("channels_as_good", [])
    if channel and (name.startswith("channel_") or others):
        name = f"{name} of {channel}" + (f" (or of {' or '.join(others)})" if others else "")
    elif others:
        name = f"{name} (or channel_response of {' or '.join(others)})"
    if like := a.get("most_like_channel"):
        name = f"{name} (most like channel {like})"
    if means := a.get("means"):
        name = f"{name} ({means})"
    return f"{name} by a curve" if settings.get("bends") else name


def _disagreement(outcome: Mapping[str, Any]) -> list[str]:
    """Words where the verification survey contradicts the calibration."""
    verify, held_out = outcome["error"].get("verify"), outcome["error"].get("held_out")
    if why := (verify or {}).get("not_possible"):
        return [f"NOT verified: {why}"]
    if not verify or not held_out:
        return [] if verify else _unseen(outcome["error"])
    if far := verify.get("strangers"):
        return [f"on the verification survey {far} differs from the others by more than a tenth of the field"]
    if turned := verify.get("turned_since"):
        return [f"on the verification survey the sensors differ as if they had been turned since: {turned}"]
    if as_read := verify.get("total_field_as_read"):
        return [f"the verification survey's total field has no {as_read}: it is judged as it was read"]
    if refuted := verify.get("not_on_this_survey"):
        return [f"NOT taken off the verification survey, for the lengths of its vectors refute it: {refuted}"]
    contradicted, beyond = str(verify.get("contradicted", "")), _beyond(verify)
    key = "total_field_rms_nT"
    before, after, here = ((b or {}).get(key) or {} for b in (verify["before"], verify["after"], held_out["after"]))
    known = [v is not None for v in (before.get("all"), after.get("all"), here.get("all"))]
    if not all(known):
        return []
    worse, apart = after["all"] > WORSE * before["all"], after["all"] > DISAGREES * here["all"]
    site = any(a.get("kind") == "site" for a in outcome["adopted"])
    largest = max(_of_all(held_out.get("before") or {}, key), here["all"])  # what the site makes of the first survey
    if (worse or apart) and site and after["all"] <= DISAGREES * largest:
        return [
            "the field of the site was modelled, not taken off: if the verification survey was made there too, it is "
            "in it and in its errors"
        ]
    if worse:
        what = f", {contradicted} above all" if contradicted else ""
        return [f"what was added makes the verification survey worse{what}: it does not carry over{beyond}"]
    if contradicted and after["all"] < before["all"]:
        return [
            "C and o help there, fitted beside what was added: |b| would be nearer to the verification survey's "
            f"total field if {contradicted} were not taken off"
        ]
    if contradicted:
        return [f"|b| would be nearer to the verification survey's total field without {contradicted}"]
    if not apart:
        return _carried_over(held_out, verify) or _of_the_tensor(held_out, verify, outcome["noise_floor_nT"])
    each = {s: v for s, v in after.items() if s != "all" and v is not None and here.get(s)}
    sensors = [s for s, v in each.items() if v > DISAGREES * here[s]]
    where = f" of {', '.join(sensors)}" if 0 < len(sensors) < len(each) else ""
    words: list[str] = []
    left = verify.get("left_by_any_calibration_nT") or 0.0
    if after["all"] > DISAGREES * left:
        words.append(
            f"the verification survey disagrees with the calibration{where}: something changed between the two, or "
            f"the first shows too little of what the second needs{beyond}"
        )
    if left > DISAGREES * here["all"]:
        too = ", or what is unexplained here too" if outcome["unexplained"]["present"] else ""
        too += ", or an effect by another law than was added" if outcome["adopted"] else ""
        too += f", or what an effect comes to beyond what is known of it{'' if words else beyond}" if beyond else ""
        words.append(
            f"the verification survey has {figure(left)} nT rms of |b| - F{where} that no calibration would take "
            f"off: noise or disturbances of its own{too}"
        )
    return words


def _not_in_use(outcome: Mapping[str, Any]) -> list[str]:
    """Words where the figures of a verification survey leave out a part of it that a reader would want to know of."""
    share = (outcome["error"].get("verify") or {}).get("share_not_in_use") or 0.0
    if share <= UNUSED:
        return []
    return [f"{share:.0%} of the verification survey's samples are flagged and in none of its figures"]


def _beyond(verify: dict[str, Any]) -> str:
    """Which effects a verification survey takes beyond what the calibration has seen."""
    return f" ({beyond})" if (beyond := verify.get("extrapolated")) else ""


def _of_the_tensor(held_out: dict[str, Any], verify: dict[str, Any], floor: float | None) -> list[str]:
    """Words where |b| of a verification survey is as it was on held-out blocks and the tensor is not: a sensor that
    repeats a vector, or one that was turned, has the right length. Of sensors that are louder there, in |b| too, it is
    no more than that."""
    here, there = (_of_all(b.get("after") or {}, "tensor_rms_nT_per_m") for b in (held_out, verify))
    louder = max(_of_all(verify["after"], "total_field_rms_nT") / floor, 1.0) if floor else 1.0
    if not 0.0 < DISAGREES * here * louder < there:
        return []
    return [
        f"the verification survey's tensor errs by {round(there / here)} times as much as on held-out blocks, its "
        "|b| does not: a gradient of that place, or a sensor that gives another vector of the same length for a while"
    ]


def _carried_over(held_out: dict[str, Any], verify: dict[str, Any]) -> list[str]:
    """Words where what takes off most of the error of held-out blocks takes off little of a verification survey's."""
    key = "total_field_rms_nT"
    before, after = verify["before"][key], verify["after"][key]
    noise = _of_all(held_out["after"], key)
    here = _of_all(held_out.get("before") or {}, key) ** 2 - noise**2
    there = before["all"] ** 2 - noise**2
    gone = before["all"] ** 2 - after["all"] ** 2
    if here < noise**2 or there < noise**2 or gone > LITTLE * there:
        return []
    return [
        f"of what the verification survey errs by beyond that, what was added takes off {gone / there:.0%} only: the "
        f"law may be another one{_beyond(verify)}, or something else is beside it there"
    ]


def _unseen(error: dict[str, Any]) -> list[str]:
    """Words where blocks that the fit has not seen err far more than what it was fitted to."""
    fit, held_out = error.get("fit") or {}, (error.get("held_out") or {}).get("after") or {}
    own, unseen = (_of_all(e, "total_field_rms_nT") for e in (fit, held_out))
    if not 0.0 < OVERFITTED * own < unseen:
        return []
    return [
        f"the fit leaves {_figure(own)} nT of the samples it has seen: the survey is too short to determine it well"
    ]


def _judged(outcome: Mapping[str, Any]) -> tuple[str, dict[str, Any] | None, dict[str, Any] | None]:
    """Where the error was judged, and the blocks before and after, the most honest there is."""
    error = outcome["error"]
    for key, where in (("verify", "on the verification survey"), ("held_out", "on held-out blocks")):
        blocks = error.get(key)
        if blocks and blocks.get("after"):
            return where, blocks["before"], blocks["after"]
    return "on the survey it was fitted to", None, error.get("fit")


def _of_all(block: dict[str, Any], key: str) -> float:
    """An error of all sensors or components; 0 where it is not known."""
    return float((block.get(key) or {}).get("all") or 0.0)


def _change(before: dict[str, Any] | None, after: dict[str, Any], key: str) -> str:
    now = _figure(after[key]["all"])
    if not before or not before.get(key):
        return now
    then = _figure(before[key]["all"])
    return now if then == now else f"{then} -> {now}"


def _figure(value: float | None) -> str:
    return "unknown" if value is None else figure(value)
