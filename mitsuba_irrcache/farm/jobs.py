"""Jobs: what workers compute, and the digest of everything that their results depend on."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.compare.scene_files import cache_digests, scene_digest
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.versions import DISTRIBUTION, installed_version

#: Packages that have to be of the same version on all machines.
SOFTWARE = (DISTRIBUTION, "mitsuba", "drjit")


class UnfitWorkerError(IrrcacheError):
    """This worker cannot run a job, while others may."""


@dataclass(frozen=True)
class Environment:
    """What all jobs of a run have in common.

    Attributes:
        variant: of Mitsuba.
        modules: Python modules that register plugins.
        software: versions by package, which have to be those of the workers.
        threads: of Dr.Jit in each worker; 0: all that the worker may use. Results do not depend on
            it.
        sources: digests by name of those modules, which have to be those of the workers.
    """

    variant: str
    modules: tuple[str, ...] = ()
    software: tuple[tuple[str, str | None], ...] = ()
    threads: int = 0
    sources: tuple[tuple[str, str], ...] = ()

    @classmethod
    def here(cls, variant: str, modules: list[str], threads: int) -> Environment:
        """Return the environment of jobs that this process, which has imported the modules,
        submits.
        """
        sources = tuple((module, source_digest(module)) for module in modules)
        return cls(variant, tuple(modules), software(), threads, sources)


@dataclass(frozen=True)
class Job:
    """One unit of work, a pure function of its ``arguments``.

    Attributes:
        name: unique in its run, also as the name of a file.
        kind: one of `work.KINDS`.
        arguments: JSON-serialisable.
        environment: that of the run.
        after: names of jobs that have to be finished before this one starts.
    """

    name: str
    kind: str
    arguments: dict
    environment: Environment
    after: tuple[str, ...] = ()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that the result depends on; the folders of the scene and of other
        files do not matter, nor does the name of its file.
        """
        environment = self.environment
        scene = self.arguments.get("scene", {})
        contents = {key: scene[key] for key in scene if key not in ("scene", "folder")}
        arguments = self.arguments | {"scene": contents}
        parts = [self.kind, arguments, environment.variant, environment.modules]
        text = json.dumps([*parts, environment.software, environment.sources], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def is_current(self) -> bool:
        """Whether the files of its scene are those that the job was made for."""
        scene = self.arguments.get("scene")
        try:
            return scene is None or contents_of(scene) == scene["contents"]
        except Exception:  # a changed file may cause any exception of Mitsuba
            return False


def software() -> tuple[tuple[str, str | None], ...]:
    """Return the versions of `SOFTWARE` in this process."""
    return tuple((name, installed_version(name)) for name in SOFTWARE)


@cache
def source_digest(module: str) -> str:
    """Return the SHA-256 of the file of an imported module, or of all Python files of a package;
    "" if it has none.

    It is kept: a process goes on with what it has imported, whatever becomes of the file.
    """
    file = getattr(sys.modules[module], "__file__", None)
    if not file or not Path(file).is_file():
        return ""
    path, sha = Path(file), hashlib.sha256()
    files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    for each in files:
        sha.update(hashlib.sha256(str(each.relative_to(path.parent)).encode()).digest())
        sha.update(hashlib.sha256(each.read_bytes()).digest())
    return sha.hexdigest()


def difference(name: str, found: str | None, wanted: str | None) -> str:
    """Return why a worker with another version of a package, or without it, is not used."""
    return f"it has {name} {found}, not {wanted}" if found else f"it lacks {name} {wanted}"


def scene_arguments(
    scene: str | Path, parameters: dict[str, str], integrator: str | None
) -> dict[str, object]:
    """Return the arguments of a job that name a scene, with the digest of its files, and the folder
    in which relative names of other files are meant.

    The variant has to be set, since Mitsuba's parser finds the files.
    """
    named = {
        "scene": str(Path(scene).resolve()),
        "parameters": parameters,
        "integrator": integrator,
        "folder": os.getcwd(),
    }
    return named | {"contents": contents_of(named), "variant": mi.variant()}


def contents_of(scene: dict) -> str:
    """Return the digest of the files that are named by arguments of a job, as they are now."""
    return scene_digest(*_place(scene))


def caches_of(scene: dict) -> dict[str, str]:
    """Return the digests of the cache files that are named by arguments of a job, and that exist
    now, by name.
    """
    return cache_digests(*_place(scene))


def _place(scene: dict) -> tuple[Path, dict[str, str], str | None, str]:
    return Path(scene["scene"]), scene["parameters"], scene["integrator"], scene["folder"]
