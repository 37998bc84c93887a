"""Which sessions an experiment has: the rounds, the last one with true labels, and those that keep clear of people."""

from __future__ import annotations

from typing import Literal, NamedTuple

Labels = Literal["none", "network", "truth"]

SCENARIOS = ("easy", "medium", "hard", "extreme")
TOURS = ("A", "B", "C")
FEWEST, MOST_ROUNDS = 1, 9  # rounds: their number is a digit of every seed
TRUTH, PREDICT, LIDAR = "truth", "predict", "hdl32e"  # groups of sessions beside the rounds
MAPPING = "mapping"


class Session(NamedTuple):
    """One drive, fixed to the bit by what stands here and by the network and the map that are there by then."""

    group: str  # "round 1" to "round n", "truth", "predict", "hdl32e" or "mapping"
    scenario: str
    tour: str
    seed: int
    labels: Labels
    people: Literal["ignore", "predict"] = "ignore"
    again: int = 0  # which repetition of scenario and tour in its group

    @property
    def folder(self) -> str:
        """Return the folder of its group."""
        return self.group.replace(" ", "-")

    @property
    def name(self) -> str:
        """Return a name that no other session of the experiment has."""
        return f"{self.folder}-{self.scenario}-{self.tour}" + (f"-{self.again + 1}" if self.again else "")


class Schedule(NamedTuple):
    """What an experiment drives. seed: its sessions' seeds are seed * 10000 and upwards, each another."""

    rounds: int = 4
    scenarios: tuple[str, ...] = SCENARIOS
    tours: tuple[str, ...] = TOURS
    mapping_tour: str = "mapping"
    seed: int = 1
    repeats: int = 1  # of the hardest scenario's tours with people predicted: collisions are rare

    def mapping(self) -> Session:
        """Return the session of the initial map: a nearly empty building."""
        return Session(MAPPING, "mapping", self.mapping_tour, self.seed * 10_000, "none")

    def round(self, number: int) -> list[Session]:
        """Return the sessions of a round, from 1: the first without labels."""
        labels: Labels = "none" if number == 1 else "network"
        return self._all(f"round {number}", number, labels)

    def truth(self) -> list[Session]:
        """Return the sessions of the last round, whose labels are the simulator's."""
        return self._all(TRUTH, self.rounds + 1, "truth")

    def predict(self) -> list[Session]:
        """Return the sessions with the last network in which the planner keeps clear of where people will be."""
        sessions = self._all(PREDICT, 11, "network", people="predict")
        hardest = [session for session in sessions if session.scenario == self.scenarios[-1]]
        for again in range(1, self.repeats):
            sessions += [item._replace(again=again, seed=item.seed + 100 * again) for item in hardest]
        return sessions

    def lidar(self) -> list[Session]:
        """Return a tour a scenario with the last network and a lidar that taught it nothing; none in one round."""
        sessions = self._all(LIDAR, 12, "network") if self.rounds > 1 else []
        return [session for session in sessions if session.tour == self.tours[0]]

    def groups(self) -> list[list[Session]]:
        """Return all sessions but the mapping, in the order in which they are driven."""
        rounds = (self.round(number + 1) for number in range(self.rounds))
        return [*rounds, self.truth(), self.predict(), self.lidar()]

    def _all(
        self, group: str, number: int, labels: Labels, *, people: Literal["ignore", "predict"] = "ignore"
    ) -> list[Session]:
        pairs = [(scenario, tour) for scenario in self.scenarios for tour in self.tours]
        first = self.seed * 10_000 + number * 100 + 1
        return [Session(group, *pair, first + index, labels, people) for index, pair in enumerate(pairs)]
