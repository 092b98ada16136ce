"""Example for an ARTIQ repository, with a kernel that does its science only if enough atoms are in place.

The controller of `artiq_controller.py` is `labseq` in `device_db.py`. `ttl_science` represents the science.
"""

from artiq.experiment import EnvExperiment, TInt32, TList, delay, kernel, ms


class Rearranged(EnvExperiment):
    """Load, let labseq rearrange, and look at the sites of a target of 15 rows and columns."""

    def build(self):
        """Take the devices and the number of shots."""
        self.setattr_device("core")
        self.setattr_device("labseq")
        self.setattr_device("ttl_science")
        self.n_shots = 10

    def prepare(self):
        """Number the sites of the target, row by row in a grid of 20 rows and columns."""
        self.target = [20 * row + column for row in range(2, 17) for column in range(2, 17)]
        self.least = 220
        self.n_science = 0
        self.n_atoms = [0 for _ in range(self.n_shots)]

    def rearrange(self, number: TInt32) -> TList(TInt32):
        """Let labseq rearrange, on the host. Returns 1 for each site with an atom, or [] on failure."""
        self.labseq.go(f"artiq {number}")
        answer = self.labseq.wait()
        return [atom for row in answer["after"] for atom in row] if answer["is_ready"] else []

    @kernel
    def run(self):
        """Take the shots. The atoms wait in their tweezers while labseq answers."""
        self.core.reset()
        for number in range(self.n_shots):
            # load the atoms here
            sites = self.rearrange(number)
            self.core.break_realtime()
            n_atoms = 0
            if len(sites) > 0:
                for site in self.target:
                    n_atoms += sites[site]
            self.n_atoms[number] = n_atoms
            if n_atoms >= self.least:
                self.science()

    @kernel
    def science(self):
        """Do the science with the atoms."""
        self.ttl_science.on()
        delay(1 * ms)
        self.ttl_science.off()
        self.n_science += 1

    def analyze(self):
        """Save the kernel's results."""
        self.set_dataset("n_atoms", self.n_atoms)
        self.set_dataset("n_science", self.n_science)
