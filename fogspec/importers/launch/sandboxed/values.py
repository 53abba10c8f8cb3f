"""What is not known while a launch file runs here: values that pass through Python's own code, and notes with their places."""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

Place = tuple[str, int, int, int]  # file, line, column, width; a column of 1 and a width of 1 mean the whole line

OWN: dict[str, str] = {}  # code of launch files: the name that its frames have, and the file here
CURRENT: list[str] = [""]  # the launch file that is played
NOTES: dict[tuple[Place, str], None] = {}
ABOUT: list[str] = []  # the node that is read
# What the marks in texts stand for: whether it is kept as it is, or why it is not known.
HELD: list[tuple[bool, str, Place]] = []
MARK = re.compile("\ue000(\\d+)\ue001")
SHOWN = re.compile(r"(?:\ue000|\\ue000)(\d+)(?:\ue001|\\ue001)")  # also as repr() shows it


class Stop(BaseException):
    """A decision that only a launch can take; no `except Exception` of a launch file catches it."""

    def __init__(self, why: str, place: Place | None = None) -> None:
        super().__init__(why)
        self.why, self.place = why, place or here()


class Refused(Exception):
    """A value that is not taken over, and why."""

    def __init__(self, why: str, place: Place | None = None) -> None:
        super().__init__(why)
        self.why, self.place = why, place


class Fatal(Exception):
    """A file that is not a launch file of ROS 2, or that launch does not start with these arguments."""

    def __init__(self, why: str, place: Place, fix: str | None = None) -> None:
        super().__init__(why)
        self.why, self.place, self.fix = why, place, fix


REFUSALS: list[Fatal] = []  # why launch does not start what is played
MISSING: dict[str, Place] = {}  # the launch arguments without a value


def missing(name: str, place: Place) -> str:
    """Return what stands for a launch argument without a value, with which launch does not start.

    Where something was not taken over before, that may give the value, or this part may not be played.
    """
    if not NOTES:
        MISSING.setdefault(name, place)
    return unknown(f"the launch argument {name} has no default: give it as {name}:=VALUE", place)


def check() -> None:
    """Raise Fatal if launch would not start what was played."""
    if REFUSALS:
        raise REFUSALS[0]
    if MISSING:
        have = "which has no default" if len(MISSING) == 1 else "which have no default"
        fix = f"give {' '.join(f'{name}:=VALUE' for name in MISSING)}"
        raise Fatal(f"launch does not start without {', '.join(MISSING)}, {have}", next(iter(MISSING.values())), fix)


def whole(line: int, path: str | None = None) -> Place:
    """Return the place of a whole line, of the launch file that is played unless another is named."""
    return path or CURRENT[0], line, 1, 1


def here() -> Place:
    """Return where the launch file is: the innermost of its own frames."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if (path := OWN.get(frame.f_code.co_filename)) is not None:
            return place_of(path, frame)
        frame = frame.f_back
    return whole(1)


def place_of(path: str, frame: FrameType) -> Place:
    """Return the expression that a frame evaluates, or its line where the expression has several."""
    for number, (line, end, start, stop) in enumerate(frame.f_code.co_positions()):
        if number == frame.f_lasti // 2:
            if line == end and None not in (line, start, stop):
                return path, line or 1, (start or 0) + 1, max(1, (stop or 0) - (start or 0))
            return path, line or frame.f_lineno or 1, 1, 1
    return path, frame.f_lineno or 1, 1, 1


@contextmanager
def about(node: str) -> Iterator[None]:
    """Name a node in what is noted inside of the block."""
    ABOUT.append(node)
    try:
        yield
    finally:
        ABOUT.pop()


def note(place: Place | None, message: str) -> None:
    """Report something that the spec does not have, once, and of which node."""
    if ABOUT:
        message = re.sub(" (is|are) not taken over: ", lambda match: f" of {ABOUT[-1]}{match[0]}", message, count=1)
    NOTES[(place or here(), message)] = None


class Text(str):
    """A text with a part that only the machine has: it goes into other texts, and code that looks into it is stopped."""

    __slots__ = ()

    def __add__(self, other: str) -> "Text":
        return Text(str.__add__(self, other)) if isinstance(other, str) else NotImplemented

    def __radd__(self, other: str) -> "Text":
        return Text(str.__add__(other, self)) if isinstance(other, str) else NotImplemented

    def __mod__(self, other: Any) -> "Text":
        return Text(str.__mod__(self, other))

    def __str__(self) -> str:
        return self

    def __fspath__(self) -> str:
        return self

    def __bool__(self) -> bool:
        # Whatever a variable or a command gives, code that tests it for being there goes the way of a machine that has it.
        if MARK.sub("", str.__str__(self)) or all(HELD[int(one)][0] for one in MARK.findall(str.__str__(self))):
            return True
        raise Stop(why(self))

    def startswith(self, prefix: Any, *rest: Any) -> bool:
        """Return it if the text before the part that is not known decides it."""
        head = str.__str__(self).partition("\ue000")[0]
        if rest or not isinstance(prefix, str) or (len(head) < len(prefix) and prefix.startswith(head)):
            self._decide()
        return head.startswith(prefix)

    def endswith(self, suffix: Any, *rest: Any) -> bool:
        """Return it if the text behind the part that is not known decides it; a variable is taken to end without a slash."""
        text = str.__str__(self)
        tail = text.rpartition("\ue001")[2]
        if rest or not isinstance(suffix, str):
            self._decide()
        if not tail and suffix == "/" and HELD[int(MARK.findall(text)[-1])][0]:
            return False
        if len(tail) < len(suffix) and suffix.endswith(tail):
            self._decide()
        return tail.endswith(suffix)

    def strip(self, *_: Any) -> "Text":
        """Return the text itself: blanks around what is not known have no meaning in a spec."""
        return self

    lstrip = rstrip = strip

    def _decide(self, *_: Any, **__: Any) -> NoReturn:
        raise Stop(why(self))


_LOOKS = (
    "__eq__ __ne__ __lt__ __le__ __gt__ __ge__ __contains__ __iter__ __getitem__ __hash__ __len__ lower upper title "
    "capitalize swapcase casefold replace split rsplit partition rpartition splitlines find rfind index rindex count "
    "isdigit isnumeric isalpha isalnum isdecimal isspace islower isupper isidentifier removeprefix removesuffix "
    "translate zfill center ljust rjust encode expandtabs istitle isascii isprintable"
)
for _name in _LOOKS.split():
    setattr(Text, _name, Text._decide)


def text(value: Any) -> Any:
    """Return a text that a launch file has put together, as a Text if a part of it is not known."""
    return Text(value) if type(value) is str and "\ue000" in value else value


def plain(value: str) -> str:
    """Return a text with its marks, without what a Text refuses."""
    return str.__str__(value) if type(value) is not Text else str.__add__("", value)


def marked(value: Any) -> bool:
    """Return whether a part of a text is not known."""
    return isinstance(value, str) and str.__contains__(value, "\ue000")


def kept(said: str, place: Place | None = None) -> Text:
    """Return a text for launch's own substitution, which the spec keeps as it is."""
    HELD.append((True, said, place or here()))
    return Text(f"\ue000{len(HELD) - 1}\ue001")


def unknown(reason: str, place: Place | None = None) -> Text:
    """Return a text that is not known, for a reason."""
    HELD.append((False, reason, place or here()))
    return Text(f"\ue000{len(HELD) - 1}\ue001")


def why(value: str) -> str:
    """Return why a text is not known."""
    for number in MARK.findall(plain(value)):
        is_kept, said, _ = HELD[int(number)]
        return f"only the machine has {said}" if is_kept else said
    return "only a launch determines it"


def unmarked(value: str) -> str:
    """Return a text with what the spec keeps in place; raise Refused if a part of it is not known."""

    def one(match: re.Match[str]) -> str:
        is_kept, said, place = HELD[int(match[1])]
        if not is_kept:
            raise Refused(said, place)
        return unmarked(said)

    found = MARK.sub(one, plain(value))
    if "\ue000" in found or "\ue001" in found:
        raise Refused("it is a part of a text that only the machine has")
    return found


class Unknown:
    """Any object of a module that is not here: it can be called and looked into, and nothing can be decided by it."""

    _why: str
    _place: Place

    def __init__(self, reason: str, place: Place | None = None) -> None:
        self.__dict__.update(_why=reason, _place=place or here())

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        return Unknown(self._why, self._place)

    def __call__(self, *_: Any, **__: Any) -> Any:
        """Return what is not known either."""
        said = f"{self._why.removesuffix(' gives')}() returns" if self._why.endswith(" gives") else self._why
        return Unknown(said, self._place if self._place[1] > 1 and said == self._why else here())

    def __str__(self) -> str:
        return unknown(self._why, self._place)

    def __format__(self, _: str) -> str:
        return unknown(self._why, self._place)

    def __repr__(self) -> str:
        return plain(unknown(self._why, self._place))

    def __fspath__(self) -> str:
        return unknown(self._why, self._place)

    def __setattr__(self, *_: Any) -> None:
        pass

    def __mro_entries__(self, _: Any) -> tuple[type, ...]:
        return (Missing,)

    def __hash__(self) -> int:
        return id(self)

    def _same(self, *_: Any) -> "Unknown":
        return self

    def _nothing(self, *_: Any) -> None:
        pass

    def _decide(self, *_: Any) -> NoReturn:
        raise Stop(self._why, self._place)


_SAME = (
    "enter getitem add radd sub rsub mul rmul truediv rtruediv mod rmod or ror and rand neg pow rpow floordiv invert"
)
_DECIDES = "bool iter len int float index contains instancecheck lt le gt ge eq ne"
for _names, _do in ((_SAME, Unknown._same), (_DECIDES, Unknown._decide), ("setitem delitem exit", Unknown._nothing)):
    for _name in _names.split():
        setattr(Unknown, f"__{_name}__", _do)


class Missing:
    """The base of a class whose own base is not here."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Unknown("it is of a class whose module is not here")


# Python's own messages name the type of what they were given.
Unknown.__name__ = Unknown.__qualname__ = TYPE = "known_only_to_the_launch"


def is_caused(problem: BaseException) -> bool:
    """Return whether an exception comes of what is not known: Python's own code was given it."""
    if isinstance(problem, Stop):
        return True
    texts = [plain(one) for one in problem.args if isinstance(one, str)]
    known = any(TYPE in one or SHOWN.search(one) for one in texts)
    return known or any(isinstance(one, Unknown) for one in problem.args)


def reason(problem: BaseException) -> str:
    """Return an exception's own words, with the reasons of what is not known in it."""
    if isinstance(problem, Stop):
        return problem.why
    texts = [plain(one) for one in problem.args if isinstance(one, str)]
    said = SHOWN.sub(lambda match: f"({HELD[int(match[1])][1]})", " ".join(texts))
    return f"{type(problem).__name__}: {said}"


def attempt(function: Callable[[], Any], what: str, place: Place | None, default: Any = None) -> Any:
    """Return what a function returns; the default, and a note, where only a launch determines it."""
    try:
        return function()
    except (Refused, Stop) as refused:
        note(refused.place or place, f"{what} not taken over: {refused.why}")
        return default
