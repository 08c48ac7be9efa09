"""What a plugin is made of: functions marked as a stage, a method, a reader or a metric.

The marked function stays an ordinary function. Its keyword-only parameters are its options: their types,
defaults and descriptions become the recipe schema, `magtensor plugins` and the documentation.

    @stage(needs=("b_raw",), gives=("b_smooth",))
    def smooth(survey, *, window_s: Annotated[float, Field(gt=0, description="length of the window, s")] = 1.0):
        \"\"\"Running mean of the raw output.\"\"\"
        return {"b_smooth": ...}
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

if TYPE_CHECKING:
    from pydantic import BaseModel

F = TypeVar("F", bound=Callable[..., Any])
Agrees = Callable[[Any, Mapping[str, Any], Any, float], bool]  # of an excitation, settings, coefficients, their share
Means = Callable[[Any, Mapping[str, Any], Mapping[tuple[str, str], float]], str]  # ..., coefficients by sensor and name

MARK = "__magtensor__"
KINDS = ("stage", "method", "reader", "metric", "error_model")


class Method:
    """Marks the option of a stage that names one of the stage's methods; see `MethodChoice`."""


class Metrics:
    """Marks the option of a stage that names metrics; see `MetricsChoice`."""


MethodChoice = Annotated[
    Any, Method()
]  # a name in the recipe, the method's function with its options bound in the stage
MetricsChoice = Annotated[Any, Metrics()]  # names in the recipe, {name: function} in the stage


class ErrorModels:
    """Marks an option of a stage that names error models; see `ErrorModelsChoice`."""


ErrorModelsChoice = Annotated[Any, ErrorModels()]  # names in the recipe, {name: (component, settings)} in the stage


class PluginError(Exception):
    """A plugin breaks the rules; the message says which and what would be right."""


@dataclass(frozen=True)
class Declares:
    """The variables a stage touches, as survey paths (`b_raw`, `reference/total_field`, `current_*`).

    needs: without them it cannot run.  uses: read where present.  gives: written.  may_give: written where
    the input allows it (a loader cannot promise a temperature).
    """

    needs: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    may_give: tuple[str, ...] = ()


@dataclass(frozen=True)
class Component:
    """A marked function with what the engine must know of it."""

    kind: str
    name: str
    function: Callable[..., Any]
    declares: Declares | Callable[..., Declares] = Declares()
    step: str = ""  # of a method: the stage it serves
    source: str = ""  # paper and equations
    suffixes: tuple[str, ...] = ()  # of a reader: the file names it recognises
    effect: Literal["", "instrument", "site", "reference"] = ""  # of an error model: what it is an error of
    typical: str = ""  # of an error model: its usual magnitude
    pointwise: bool = False  # of an error model: its regressors at a sample need no other sample
    agrees: Agrees | None = None  # of an error model: what was fitted with it
    about: Callable[[Mapping[str, Any], Any], Mapping[str, Any]] | None = None  # settings that coefficients ask for
    means: Means | None = None  # of an error model: what its coefficients say together
    several: bool = False  # of a stage: it also fits the further surveys that a recipe names
    long: Callable[..., Any] | None = None  # of a stage: what it does with a recording longer than the memory

    @cached_property
    def summary(self) -> str:
        """The docstring's first paragraph on one line."""
        doc = inspect.getdoc(self.function) or ""
        return " ".join(doc.split("\n\n", 1)[0].split())

    def declared(self, options: Mapping[str, Any], *, several: bool = False) -> Declares:
        """What the stage touches when run with these options, on one survey or on several.

        Raises:
            UsageError: the options contradict each other.
        """
        if not callable(self.declares):
            return self.declares
        return self.declares(options, several=several) if self.several else self.declares(options)

    @cached_property
    def parameters(self) -> dict[str, inspect.Parameter]:
        """The keyword-only parameters: the options. Annotations are resolved."""
        found = {}
        for p in inspect.signature(self.function).parameters.values():
            if p.kind is inspect.Parameter.VAR_KEYWORD:
                raise PluginError(f"{self.kind} {self.name}: **{p.name} hides the options; name each of them")
            if p.kind is not inspect.Parameter.KEYWORD_ONLY:
                continue
            if p.annotation is inspect.Parameter.empty:
                raise PluginError(f"{self.kind} {self.name}: option {p.name} has no type")
            annotation = p.annotation
            if isinstance(annotation, str):
                try:
                    annotation = eval(annotation, getattr(self.function, "__globals__", {}))
                except NameError as error:
                    raise PluginError(f"{self.kind} {self.name}: type of option {p.name}: {error}") from error
            found[p.name] = p.replace(annotation=annotation)
        return found

    def _marked_with(self, marker: type) -> str | None:
        for name, p in self.parameters.items():
            if any(isinstance(a, marker) for a in getattr(p.annotation, "__metadata__", ())):
                return name
        return None

    @cached_property
    def collections(self) -> dict[str, str]:
        """The options that name several components, with the kind they name."""
        kinds = {Metrics: "metric", ErrorModels: "error_model"}
        return {
            name: kind
            for name, p in self.parameters.items()
            for marker, kind in kinds.items()
            if any(isinstance(a, marker) for a in getattr(p.annotation, "__metadata__", ()))
        }

    @cached_property
    def method_option(self) -> tuple[str, str | None] | None:
        """The option that names a method, with its default; None for a stage without methods."""
        name = self._marked_with(Method)
        if name is None:
            return None
        default = self.parameters[name].default
        return name, None if default is inspect.Parameter.empty else default

    @cached_property
    def options(self) -> type[BaseModel]:
        """The pydantic model of the options, those that name methods or metrics left out."""
        from pydantic import ConfigDict, create_model

        components = {*self.collections, self.method_option[0] if self.method_option else None}
        fields: dict[str, Any] = {
            name: (p.annotation, ... if p.default is inspect.Parameter.empty else p.default)
            for name, p in self.parameters.items()
            if name not in components
        }
        config = ConfigDict(extra="forbid", strict=True, validate_default=True)
        return create_model(self.name, __config__=config, **fields)

    def check(self) -> None:
        """See that the options can be options.

        Raises:
            PluginError: an option has no type, one that no value of a recipe can have, or a default of another type.
        """
        from pydantic import PydanticUserError, TypeAdapter, ValidationError

        try:
            self.options.model_validate({})
        except PydanticUserError as error:
            for name, p in self.parameters.items():
                try:
                    TypeAdapter(p.annotation)
                except PydanticUserError:
                    what = f"option {name} has a type that no recipe can give"
                    raise PluginError(f"{self.kind} {self.name}: {what}") from None
            raise PluginError(f"{self.kind} {self.name}: {error}") from error
        except ValidationError as error:
            for one in error.errors(include_url=False):
                if one["type"] != "missing":
                    what = f"default of option {one['loc'][0]}: {one['msg']}"
                    raise PluginError(f"{self.kind} {self.name}: {what}") from error


def _mark(kind: str, name: str | None, **facts: Any) -> Callable[[F], F]:
    def decorate(function: F) -> F:
        setattr(function, MARK, Component(kind, name or function.__name__, function, **facts))
        return function

    return decorate


def _with_parentheses(kind: str, given: object) -> None:
    """`@stage` alone would make the function the decorator's argument."""
    if callable(given):
        raise TypeError(f"write @{kind}(...) with parentheses above {getattr(given, '__name__', 'the function')}")


def stage(
    function: None = None,
    /,
    *,
    name: str | None = None,
    needs: Iterable[str] = (),
    uses: Iterable[str] = (),
    gives: Iterable[str] = (),
    may_give: Iterable[str] = (),
    declares: Callable[..., Declares] | None = None,
    several: bool = False,
    long: Callable[..., Any] | None = None,
) -> Callable[[F], F]:
    """Mark ``function(survey, *, options) -> {path: variable}`` as a stage.

    The survey is read-only; what the function returns is merged into it by the runner, which checks both
    against the declaration. `declares`, a function of the options, replaces the four lists where they depend on these;
    it may refuse options that contradict each other (UsageError).

    A stage that fits the further surveys of a recipe (`survey: {with: ...}`) together with the survey is `several`; it
    finds them in ``survey.source.further_surveys()``, and its `declares` takes the keyword `several`: whether there are
    any.

    A stage that calibrates, and can do so from a recording that is read in pieces, names as `long` a function of
    ``(survey, recording, *, options)`` that returns the variables and the samples (N,) of the recording to flag; the
    survey is then a selection of the recording (`magtensor.long_survey`).
    """
    _with_parentheses("stage", function)
    return _mark(
        "stage",
        name,
        declares=declares or Declares(tuple(needs), tuple(uses), tuple(gives), tuple(may_give)),
        several=several,
        long=long,
    )


def method(step: str, *, name: str | None = None, source: str = "") -> Callable[[F], F]:
    """Mark a function as one of the methods of stage `step`; the stage documents the signature it calls."""
    _with_parentheses("method", step)
    return _mark("method", name, step=step, source=source)


def reader(function: None = None, /, *, name: str | None = None, suffixes: Iterable[str] = ()) -> Callable[[F], F]:
    """Mark ``function(paths, *, options) -> RawTables`` as a file reader for these file-name endings."""
    _with_parentheses("reader", function)
    return _mark("reader", name, suffixes=tuple(suffixes))


def metric(
    function: None = None, /, *, name: str | None = None, needs: Iterable[str] = (), uses: Iterable[str] = ()
) -> Callable[[F], F]:
    """Mark ``function(survey, *, options) -> list[Verdict]`` as a QC metric."""
    _with_parentheses("metric", function)
    return _mark("metric", name, declares=Declares(tuple(needs), tuple(uses)))


def error_model(
    effect: Literal["instrument", "site", "reference"],
    *,
    name: str | None = None,
    needs: Iterable[str] = (),
    source: str = "",
    typical: str = "",
    pointwise: bool = False,
    agrees: Agrees | None = None,
    about: Callable[[Mapping[str, Any], Any], Mapping[str, Any]] | None = None,
    means: Means | None = None,
) -> Callable[[F], F]:
    """Mark ``function(x: Excitation, *, settings) -> Terms`` as an error model.

    Args:
        effect: "instrument" (corrected in every survey), "site" (modelled while calibrating, never taken off
            another survey's field) or "reference" (corrects the total field).
        name: the function's own if left out.
        needs: channels and facts without which it cannot be tried: names of channels (`temperature`,
            `current_*`), `attitude`, `position`, `total_field`, `turning` (the platform does not stand still),
            `rotation` (samples dense enough for rates of change).
        source: where the model comes from.
        typical: its usual magnitude, in words.
        pointwise: its regressors at a sample follow from that sample alone (logged channels may be lagged), so that its
            settings are searched on a few samples only, without the others being computed.
        agrees: of the excitation, settings, fitted coefficients (P,) and the share of |b| - F that they explain, white
            noise apart, whether these are what they must be to each other; the loop adopts nothing of which they are
            not.
        about: of settings and fitted coefficients (P,), the settings about which a model that is linear only nearby
            has to be made for such coefficients; the loop moves there where the data allow it.
        means: of the excitation, settings and fitted coefficients by sensor and name, what they say together and not
            one by one, in a few words for the verdict; "" where they say nothing more.
    """
    _with_parentheses("error_model", effect)
    return _mark(
        "error_model", name, declares=Declares(tuple(needs)), effect=effect, source=source, typical=typical,
        pointwise=pointwise, agrees=agrees, about=about, means=means,
    )  # fmt: skip


def component_of(candidate: object) -> Component | None:
    """The component a marked function carries, else None."""
    found = own_attribute(candidate, MARK)
    return found if isinstance(found, Component) else None


def own_attribute(thing: object, name: str) -> Any:
    """An attribute that was set on the thing itself; never one that it makes up when asked, as mocks do."""
    own = getattr(thing, "__dict__", None)
    return own.get(name) if isinstance(own, dict) else None
