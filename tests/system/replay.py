"""Replay of plans, one site at a time, from the rules alone: nothing of labseq is used here.

labseq plan random:20x20@0.75 --seed 1 --target kagome --json - | python tests/system/replay.py

Reads one plan as JSON per line and says what is wrong with each.
"""

import json
import sys
from itertools import pairwise, product

INSTANTS_PER_SITE = 4


class Broken(Exception):  # noqa: N818 - a verdict
    """A plan breaks a rule, or does not do what it says."""


def require(condition, what):
    if not condition:
        raise Broken(what)


def sites_of(rows):
    return {(r, c) for r, row in enumerate(rows) for c, bit in enumerate(row) if bit}


class Array:
    """Atoms on a grid, and what moves them."""

    def __init__(self, document):
        self.n_rows, self.n_cols = document["grid"]["n_rows"], document["grid"]["n_cols"]
        self.most_tweezers = document["degree_of_parallelism"]
        self.atoms = sites_of(document["occupancy"])
        self.held = []  # sites whose tweezers the last batch left on

    def on_grid(self, site):
        return 0 <= site[0] < self.n_rows and 0 <= site[1] < self.n_cols

    def play(self, batch, goes_on):
        """Play one batch; ``goes_on`` says that the next one is linked to it."""
        starts, ends = ([tuple(site) for site in batch[key]] for key in ("from", "to"))
        require(len(starts) == len(ends) > 0, "a batch without moves, or with half a move")
        require(len(set(starts)) == len(starts) and len(set(ends)) == len(ends), "a site is named twice")
        require(set(starts) <= self.atoms, "an atom is picked up where there is none")
        if batch["linked"]:
            require(sorted(starts) == sorted(self.held), "a linked batch goes on from other sites")
        standing = self.atoms - set(starts)
        self.follow(list(zip(starts, ends, strict=True)), standing)
        for start, end in zip(starts, ends, strict=True):
            self.check_end(start, end, goes_on)
        self.atoms = standing | {end for end in ends if self.on_grid(end)}
        self.held = ends if goes_on else []

    def follow(self, moves, standing):
        """Follow the row and column tones through many instants."""
        tones = []
        for axis in (0, 1):
            ways = {(start[axis], end[axis]) for start, end in moves}
            require(len({start for start, _ in ways}) == len(ways), "a tone would have to go two ways")
            tones.append(sorted(ways))
        moving = [any(start != end for start, end in ways) for ways in tones]
        require(moving != [True, True], "tones of both axes move")
        n_tweezers = len(tones[0]) * len(tones[1])
        require(n_tweezers <= self.most_tweezers, f"{n_tweezers} tweezers are on")
        longest = max(abs(end - start) for ways in tones for start, end in ways)
        for instant in range(longest * INSTANTS_PER_SITE + 1):
            travelled = instant / INSTANTS_PER_SITE
            rows, cols = ([place(start, end, travelled) for start, end in ways] for ways in tones)
            for places in (rows, cols):
                require(all(b - a >= 1 for a, b in pairwise(places)), "two tones come closer than a site")
            require(standing.isdisjoint(product(rows, cols)), "a tweezer meets an atom that is to stand")

    def check_end(self, start, end, goes_on):
        if self.on_grid(end):
            return
        require(not goes_on, "an ejected atom is moved on")
        beside = (-1, self.n_rows)[end[0] > 0], (-1, self.n_cols)[end[1] > 0]
        along_row = end[0] == start[0] and end[1] == beside[1]
        along_column = end[1] == start[1] and end[0] == beside[0]
        require(along_row or along_column, f"an atom from {start} is ejected to {end}")


def place(start, end, travelled):
    """Where a tone is that moves at one speed and stops at its end."""
    return min(start + travelled, end) if end >= start else max(start - travelled, end)


def replay(document):
    """Play a plan, and compare what comes of it with its target and its own words.

    Raises:
        Broken: With what is wrong.
    """
    array = Array(document)
    batches = document["batches"]
    n_atoms = len(array.atoms)
    for number, batch in enumerate(batches):
        goes_on = number + 1 < len(batches) and batches[number + 1]["linked"]
        try:
            array.play(batch, goes_on)
        except Broken as broken:
            raise Broken(f"batch {number}: {broken}") from None
    fill, clear = (sites_of(document["target"][key]) for key in ("fill", "clear"))
    require(not fill & clear, "a site is to be full and empty")
    missing = len(fill - array.atoms)
    require(missing == max(0, len(fill) - n_atoms), f"{missing} of {len(fill)} fill sites are empty")
    require(not clear & array.atoms, f"{len(clear & array.atoms)} clear sites hold an atom")
    require(array.atoms == sites_of(document["predicted"]), "another array was predicted")
    require(document["n_batches"] == len(batches), "the number of batches is another")
    n_atom_moves = sum(len(batch["from"]) for batch in batches)
    require(document["n_atom_moves"] == n_atom_moves, "the number of atom moves is another")


def main():
    n_plans = n_broken = 0
    for line in sys.stdin:
        document = json.loads(line)
        n_plans += 1
        try:
            replay(document)
        except Broken as broken:
            n_broken += 1
            print(f"plan {n_plans}, seed {document['seed']}: {broken}")
    print(f"{n_plans} plans, {n_broken} broken")
    return 1 if n_broken or not n_plans else 0


if __name__ == "__main__":
    sys.exit(main())
