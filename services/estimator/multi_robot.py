"""Schedules the estimators of several robots in one process.

A round takes one question of every robot that tracks. A search has the time that tracking leaves, and a quarter of the
beams at least; of several searches the one that began first goes on until it has ended.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from services.estimator.shared.asking import Conversation, Conversing, Pieces, Question, Search, in_pieces

if TYPE_CHECKING:
    from services.estimator.shared.interface import Estimator, Observation, Posterior

PIECE = 2000  # beams: a millisecond or two, after which whoever tracks comes first
SHARE = 3  # times the beams of a piece that tracking may take before a search that waits has one
TOGETHER = 4  # questions in one call of a model: more of them leave the processor's cache, and take longer


@dataclass(frozen=True)
class Outcome:
    """What became of one robot's scan: one of the two."""

    robot: str
    posterior: Posterior | None
    error: Exception | None = None


class Fleet:
    """The scans that are being answered, at most one a robot."""

    def __init__(self, piece: int = PIECE, together: int = TOGETHER) -> None:
        """``piece``: beams of a search between two looks at who tracks; ``together``: questions in one call."""
        self.piece, self.together = piece, together
        self.calls = self.answered = 0  # of models, and questions they answered
        self._tracking: dict[str, tuple[Conversation[Posterior], Question]] = {}
        self._searches: dict[str, Pieces[Posterior]] = {}  # in the order they began
        self._ended: deque[Outcome] = deque()
        self._owed = 0  # beams that tracking took while a search waited

    def begin(self, robot: str, estimator: Estimator, observation: Observation) -> None:
        """One more scan of a robot that is not `busy`; an estimator that does not converse answers it here."""
        if self.busy(robot):
            raise ValueError(f"{robot} has a scan that is not answered yet")
        if isinstance(estimator, Conversing):
            self._go_on(robot, estimator.updating(observation), None)
            return
        try:
            self._ended.append(Outcome(robot, estimator.update(observation)))
        except Exception as error:  # noqa: BLE001 - it is that robot's, and the shell's to tell
            self._ended.append(Outcome(robot, None, error))

    def busy(self, robot: str) -> bool:
        """Whether its last scan is not answered yet."""
        return (
            robot in self._tracking or robot in self._searches or any(outcome.robot == robot for outcome in self._ended)
        )

    @property
    def idle(self) -> bool:
        """Whether every scan is answered."""
        return not (self._tracking or self._searches or self._ended)

    @property
    def searching(self) -> int:
        """Robots that search."""
        return len(self._searches)

    def drop(self, robot: str) -> None:
        """Forget a robot's scan."""
        self._tracking.pop(robot, None)
        self._searches.pop(robot, None)
        self._ended = deque(outcome for outcome in self._ended if outcome.robot != robot)

    def step(self) -> list[Outcome]:
        """A round of those that track, or a piece of a search; the scans that are answered by now."""
        if self._tracking and not (self._searches and self._owed >= SHARE * self.piece):
            self._round()
        elif self._searches:
            self._owed = 0
            self._search()
        ended = list(self._ended)
        self._ended.clear()
        return ended

    def _round(self) -> None:
        alike: dict[Hashable, list[str]] = defaultdict(list)
        for robot, (_, question) in self._tracking.items():
            alike[type(question), question.alike].append(robot)
        for robots in alike.values():
            for begin in range(0, len(robots), self.together):
                self._answer(robots[begin : begin + self.together])

    def _answer(self, robots: list[str]) -> None:
        """One call of a model; where that fails, one each, so that whose question it is fails alone."""
        asked = [(robot, *self._tracking.pop(robot)) for robot in robots]
        questions = [question for _, _, question in asked]
        if self._searches:
            self._owed += sum(question.beams for question in questions)
        self.calls, self.answered = self.calls + 1, self.answered + len(asked)
        try:
            answers = questions[0].answer_all(questions) if len(asked) > 1 else [questions[0].answer()]
        except Exception as error:  # noqa: BLE001 - told to the conversation it belongs to
            if len(asked) == 1:
                self._fail(*asked[0][:2], error)
                return
            for robot, conversation, question in asked:
                self._tracking[robot] = conversation, question
                self._answer([robot])
            return
        for (robot, conversation, _), answer in zip(asked, answers, strict=True):
            self._go_on(robot, conversation, answer)

    def _go_on(self, robot: str, conversation: Conversation[Posterior], answer: Any) -> None:
        """Until its next question, its search, or its end."""
        try:
            question = conversation.send(answer)
        except StopIteration as end:
            self._ended.append(Outcome(robot, end.value))
        except Exception as error:  # noqa: BLE001 - that robot's
            self._ended.append(Outcome(robot, None, error))
        else:
            if isinstance(question, Search):
                self._searches[robot] = in_pieces(conversation, self.piece)
            else:
                self._tracking[robot] = conversation, question

    def _fail(self, robot: str, conversation: Conversation[Posterior], error: Exception) -> None:
        conversation.close()
        self._ended.append(Outcome(robot, None, error))

    def _search(self) -> None:
        robot = next(iter(self._searches))
        try:
            next(self._searches[robot])
        except StopIteration as end:
            self._ended.append(Outcome(robot, end.value))
        except Exception as error:  # noqa: BLE001 - that robot's
            self._ended.append(Outcome(robot, None, error))
        else:
            return
        del self._searches[robot]
