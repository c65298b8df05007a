"""The choice of device, local processes or cluster, shared by all verbs.

In: a user's choice. Out: `Compute`, whose fields a verb either uses or refuses by name.
"""

from dataclasses import dataclass

from patchproof.base.errors import Refused


@dataclass(frozen=True)
class Compute:
    """The device and processes that work runs on. Results do not depend on `jobs` if one job uses one thread, too.

    Attributes:
        device: torch device of scene and networks, "cpu" or "cuda"; photographs are judged on the CPU only.
        jobs: processes on this machine that share the work, 1 or more.
        cluster: address of a dask scheduler whose workers do the work in place of this machine's; None for no cluster.
    """

    device: str = "cpu"
    jobs: int = 1
    cluster: str | None = None

    def without(self, verb: str, *, device: bool = False, cluster: bool = False) -> "Compute":
        """Return this object; refused if it names a device or cluster that `verb`, by the keywords, cannot use."""
        if device and self.device != "cpu":
            raise Refused(f'device = "cpu" for {verb}', f'"{self.device}"', "leave device out of Compute")
        if cluster and self.cluster is not None:
            raise Refused(f"no cluster for {verb}", f'"{self.cluster}"', "use jobs, which share this machine")
        return self
