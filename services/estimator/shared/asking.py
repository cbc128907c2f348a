"""Splits an update into pieces that several robots can interleave (to be replaced by plain calls).

Alone, each question is answered at once. A fleet answers the questions of many robots together, and those of a search
piece by piece, between which the other robots are served. What an estimator computes is the same.
"""

from __future__ import annotations

from collections.abc import Generator, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

if TYPE_CHECKING:
    from services.estimator.shared.interface import Observation, Posterior

T = TypeVar("T")
Pieces = Generator[None, None, T]  # work with pauses


class Question(Protocol):
    """Something costly that depends on nothing but what it holds."""

    @property
    def alike(self) -> Hashable:
        """Questions of one class for which this is equal can be answered together."""
        ...

    @property
    def beams(self) -> int:
        """How much there is to compute: beams predicted."""
        ...

    def answer(self) -> Any:
        """Now."""
        ...

    def answer_all(self, questions: Sequence[Any]) -> list[Any]:
        """Of several that are alike, this one among them, in their order."""
        ...

    def in_pieces(self, beams: int) -> Pieces[Any]:
        """The same answer with a pause after about every so many beams."""
        ...


class Search:
    """Said in place of a question: what follows is a search from nothing, not the next step of tracking."""


Conversation = Generator[Question | Search, Any, T]


@runtime_checkable
class Conversing(Protocol):
    """An estimator whose update can be had as a conversation."""

    def updating(self, observation: Observation) -> Conversation[Posterior]:
        """What `update` does; until it ends, nothing else may be asked of the estimator."""
        ...


def alone(conversation: Conversation[T]) -> T:
    """Its result, every question answered at once."""
    return without_pause(in_pieces(conversation, None))


def without_pause(pieces: Pieces[T]) -> T:
    """All of the work at once."""
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            result: T = end.value
            return result


def in_pieces(conversation: Conversation[T], beams: int | None) -> Pieces[T]:
    """The same with a pause after about every so many beams, or none; the conversation may have begun."""
    answer: Any = None
    while True:
        try:
            question = conversation.send(answer)
        except StopIteration as end:
            result: T = end.value
            return result
        if isinstance(question, Search):
            answer = None
        elif beams is None:
            answer = question.answer()
        else:
            answer = yield from question.in_pieces(beams)
            yield
