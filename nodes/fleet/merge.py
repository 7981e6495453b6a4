"""Many maps of one building merged into tiles, in parallel and out of core.

Three steps, each of independent tasks: find where the maps lie, cut each map into pieces, fuse the pieces of each tile.
Names of alignments, pieces and tiles say all that decides their content, so that what is there is not done again, and
the same maps give the same bytes in whichever order tasks run. ``tiles.json`` is created last, once; before, no reader
sees a tile. A task has one map in memory (``tiles.MEMORY_MB`` of it; two where maps are aligned), or one tile.

Layout, beside what ``Store`` has:

    tiles.json                      the manifest (``mapping.files.tiles``)
    tiles/X_Y_Z-PLAN.npz            a tile
    alignments/MAP-MAP-VERSION.json where one map lies in another, or why that is not known
    pieces/KEY/X_Y_Z.npz            while a merge runs: what a map says of a tile; pieces.json is written last
    tiles/X_Y_Z-PLAN.json           while a merge runs: the tile's row of the manifest
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import msgspec
import numpy as np

from semantic_mapper.errors import ConfigError, FleetError, MapError, SemanticMapperError
from semantic_mapper.geometry import check_pose, yaw_transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.files.map_file import open_map
from semantic_mapper.mapping.files.map_manifest import MapManifest
from semantic_mapper.mapping.files.tiles import (
    EDGE_BLOCKS,
    TILES_NAME,
    Rows,
    TileIndex,
    TileManifest,
    TileRow,
    TileSource,
    check_tile,
    content_digest,
    cut_map,
    encode_tiles,
    fuse_pieces,
    load_to_cut,
    merged_header,
    parse_tiles,
    tile_digest,
    write_piece,
)
from semantic_mapper.mapping.map_alignment import find_alignment
from semantic_mapper.nodes.fleet.cluster import Cluster
from semantic_mapper.nodes.fleet.store import Store, check_result_file, open_store
from semantic_mapper.nodes.fleet.urls import is_url, persistently, shown, split_url
from semantic_mapper.queries.tiles import describe_tile
from semantic_mapper.types import Float64

MERGE_VERSION = 3  # part of all names: raise it where the same maps would give other places or tiles
TASK_BYTES = 3_000_000_000  # of memory that a task declares: two maps of ``tiles.MEMORY_MB`` and the libraries
MAP_NAME = "map.npz"
_WAY_OUT = "Give it in the file of --poses"

_log = get_logger(__name__)

_R = TypeVar("_R")


class Run(Protocol):
    """Runs independent tasks and gives their results in the order of the jobs; ``done`` is called after each."""

    def __call__(
        self, function: Callable[..., _R], jobs: Sequence[tuple[Any, ...]], done: Callable[[], None]
    ) -> list[_R]:
        """``[function(*job) for job in jobs]``."""
        ...


class Bar(Protocol):
    """Progress of one step."""

    def advance(self, count: int = 1) -> None:
        """This many more tasks are done."""
        ...


Stage = Callable[[str, int, str], AbstractContextManager[Bar]]  # name, number of tasks, what they are of


@dataclass(frozen=True, slots=True)
class MapFacts:
    """What is known of a map before its blocks are read.

    Args:
        url: Of its file.
        name: For people, unique among the maps.
        digest: Of its content.
        header: Its manifest.
        places: Digests of the frames and features that it is found by.
    """

    url: str
    name: str
    digest: str
    header: MapManifest
    places: frozenset[bytes]


class Alignment(msgspec.Struct, frozen=True):
    """Where one map lies in another.

    Args:
        T_map_other: (4, 4); None = not known.
        agreeing, looked_for: Places of the other that say so, of so many.
        refusal: Why it is not known.
        peak_bytes: Memory of the worker that has looked for it.
    """

    T_map_other: Rows | None
    agreeing: int = 0
    looked_for: int = 0
    refusal: str = ""
    peak_bytes: int = 0


class Placed(NamedTuple):
    """A map with where it lies; ``note`` says how that is known, and ``peak_bytes`` what it took to find out."""

    facts: MapFacts
    source: TileSource
    note: str
    peak_bytes: int


class _Cut(NamedTuple):
    """What became of a map: the tiles that it reaches, and the memory of the worker."""

    key: str
    tiles: tuple[TileIndex, ...]
    peak_bytes: int


class _Fused(NamedTuple):
    row: TileRow
    peak_bytes: int


@dataclass(frozen=True, slots=True)
class MergeReport:
    """What a merge has done.

    Args:
        manifest: Of the tiles.
        notes: How the place of each map is known.
        peak_bytes: Greatest memory of a worker, libraries included; 0 where nothing was left to do.
    """

    manifest: TileManifest
    notes: tuple[str, ...]
    peak_bytes: int


def merge_maps(
    maps: Sequence[str],
    store: Store,
    poses: Mapping[str, Float64],
    run: Run,
    stage: Stage,
    edge_blocks: int = EDGE_BLOCKS,
) -> MergeReport:
    """Merge saved maps into tiles.

    Args:
        maps: Paths or URLs of map files, or of folders with a ``map.npz``.
        store: Where the tiles go.
        poses: T_world_map (4, 4) by name of a map; places of the others are found. Without any, the world is that of
            the first map.
        run: Runs the tasks.
        stage: Shows the progress of each step.
        edge_blocks: Edge of a tile in blocks of 8 voxels.

    Raises:
        ConfigError: a pose of no map, the same map twice, or the store has tiles of other maps.
        MapError: maps that do not fit each other, have seen the same frames, or fit nowhere; a map is damaged.
        StoreError: the store cannot be reached.
    """
    names = check_names(maps, poses)
    with stage("read", len(maps), "maps") as bar:
        facts = run(_read_facts, list(zip(map(_file_of, maps), names, strict=True)), bar.advance)
    header = merged_header([one.header for one in facts], names)
    _refuse_shared_frames(facts)
    given = {n: poses.get(name, poses.get(url)) for n, (name, url) in enumerate(zip(names, maps, strict=True))}
    placed = _place(facts, {n: T for n, T in given.items() if T is not None}, store, run, stage)
    sources = tuple(one.source for one in placed)
    plan = _digest([MERGE_VERSION, edge_blocks, [(s.digest, s.T_world_map) for s in sources]])
    notes = tuple(one.note for one in placed)
    manifest = _there(store, plan) if store.exists(TILES_NAME) else None
    lost = set() if manifest is None else _lost_tiles(store, manifest)
    if manifest is not None and not lost:
        return MergeReport(manifest, notes, 0)
    if lost:
        _log.warning("tiles_missing", store=store.shown, tiles=len(lost), then="they are made again")

    jobs = [(store.url, one.facts.url, one.source, edge_blocks) for one in placed]
    with stage("cut", len(jobs), "maps") as bar:
        cuts = run(_cut, jobs, bar.advance)
    reached: dict[TileIndex, list[str]] = {}
    for cut in cuts:
        for index in cut.tiles:
            reached.setdefault(index, []).append(f"pieces/{cut.key}/{_name_of(index)}.npz")
    wanted = sorted(index for index in reached if manifest is None or index in lost)
    jobs = [(store.url, plan, index, reached[index], header, edge_blocks) for index in wanted]
    with stage("fuse", len(jobs), "tiles") as bar:
        fused = run(_fuse, jobs, bar.advance)
    if manifest is None:
        manifest = TileManifest(
            plan=plan,
            config=header.config,
            label_set=header.label_set,
            edge_blocks=edge_blocks,
            frames=header.frames,
            last_stamp_ns=header.last_stamp_ns,
            refined=header.refined,
            scale=header.scale,
            sources=sources,
            tiles=tuple(tile.row for tile in fused if tile.row.blocks),
        )
        if not store.create(TILES_NAME, encode_tiles(manifest)):
            manifest = _there(store, plan)
    _remove_scraps(store, manifest)
    peak = max((one.peak_bytes for one in (*placed, *cuts, *fused)), default=0)
    _log.info("maps_merged", store=store.shown, maps=len(maps), tiles=len(manifest.tiles), blocks=manifest.blocks)
    return MergeReport(manifest, notes, peak)


def run_on_ray(cluster: Cluster, max_parallel: int = 0) -> Run:
    """Runs tasks on the cluster that is connected, each on one processor; tasks of killed workers run again.

    Args:
        cluster: That this process is connected with.
        max_parallel: Tasks at a time; 0 = as many as there are processors and memory for.
    """
    memory = min(TASK_BYTES, cluster.memory_bytes // max(1, cluster.nodes))

    def run(function: Callable[..., _R], jobs: Sequence[tuple[Any, ...]], done: Callable[[], None]) -> list[_R]:
        import ray
        from ray.exceptions import RayError, RayTaskError

        task = ray.remote(num_cpus=1, memory=memory)(_caught)
        waiting = list(enumerate(jobs))[::-1]
        running: dict[Any, int] = {}
        results: dict[int, _R] = {}
        limit = max_parallel or len(jobs)
        while waiting or running:
            while waiting and len(running) < limit:
                number, job = waiting.pop()
                running[task.remote(function, job)] = number
            (ready, *_), _ = ray.wait(list(running))
            number = running.pop(ready)
            where = f"task {number + 1} of {len(jobs)} ({function.__name__.strip('_')})"
            try:
                result, error = ray.get(ready)
            except RayTaskError as failure:
                cause = failure.cause
                raise FleetError(
                    f"{where} failed: {type(cause).__name__}: {cause}; run the merge again after you have mended that, "
                    "what is done stays done"
                ) from cause
            except RayError as failure:
                raise FleetError(
                    f"{where} was lost with its worker ({str(failure).splitlines()[0]}); run the merge again, what is "
                    "done stays done"
                ) from failure
            if error is not None:
                raise error
            results[number] = result
            done()
        return [results[number] for number in range(len(jobs))]

    return run


def read_poses(path: Path) -> dict[str, Float64]:
    """Where maps lie, by their names.

    Args:
        path: JSON, an object whose values are 4 rows of 4 numbers (T_world_map) or [x, y, z, yaw_deg]; or text, a line
            ``NAME x y z yaw_deg`` for each map; yaw is about +z.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
        PoseError: a matrix is no rigid transform.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--poses {path}: cannot be read: {error}") from error
    found: dict[str, Any] = {}
    if text.lstrip().startswith("{"):
        try:
            found = msgspec.json.decode(text, type=dict[str, list[Any]])
        except msgspec.DecodeError as error:
            raise ConfigError(f"--poses {path}: {error}; write {{NAME: [x, y, z, yaw_deg] or 4 rows of 4}}") from error
    else:
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split("#")[0].split()
            if not words:
                continue
            try:
                name, x, y, z, yaw = words[0], *map(float, words[1:])
            except ValueError as error:
                raise ConfigError(f"--poses {path}, line {number}: write NAME x y z yaw_deg") from error
            if name in found:
                raise ConfigError(f"--poses {path}, line {number}: {name} has a pose already; give it one")
            found[name] = [x, y, z, yaw]
    return {name: _pose_of(values, f"--poses {path}: {name}") for name, values in found.items()}


def check_names(maps: Sequence[str], poses: Mapping[str, Float64]) -> list[str]:
    """Names of the maps, after a look at whether the poses are of them.

    Raises:
        ConfigError: a map comes twice, or a pose is of no map.
    """
    names = map_names(maps)
    unknown = sorted(set(poses) - set(names) - set(maps))
    if unknown:
        raise ConfigError(f"--poses names {', '.join(unknown)}, but the maps are {', '.join(names)}")
    return names


def map_names(maps: Sequence[str]) -> list[str]:
    """A short name of each map: that of its file, or of the folder where this is ``map.npz``; else all of its path.

    Raises:
        ConfigError: a map comes twice.
    """
    if len(set(maps)) < len(maps):
        twice = next(url for url in maps if maps.count(url) > 1)
        raise ConfigError(f"{shown(twice)}: is given twice")
    short: list[str] = []
    for url in maps:
        parts = url.rstrip("/").removesuffix("/" + MAP_NAME).rsplit("/", 1)
        short.append(parts[-1].removesuffix(".npz"))
    return [name if short.count(name) == 1 and name else shown(url) for name, url in zip(short, maps, strict=True)]


def _pose_of(given: list[Any], where: str) -> Float64:
    try:
        values = np.array(given, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: expected numbers, got {given}") from error
    if values.shape == (4,):
        values = yaw_transform(values[:3], float(values[3]))
    if values.shape != (4, 4):
        raise ConfigError(f"{where}: expected 4 rows of 4 numbers or [x, y, z, yaw_deg], got shape {values.shape}")
    check_pose(values, where)
    return values


def _file_of(url: str) -> str:
    """The map file that a path or URL means."""
    if is_url(url):
        return url if url.endswith(".npz") else f"{url.rstrip('/')}/{MAP_NAME}"
    path = Path(url)
    return str((path / MAP_NAME if path.is_dir() else path).absolute())


def _refuse_shared_frames(facts: Sequence[MapFacts]) -> None:
    for n, one in enumerate(facts):
        for other in facts[:n]:
            if shared := len(one.places & other.places):
                raise MapError(
                    f"{other.name} and {one.name} were made with the same frames ({shared} of their places are of the "
                    "same ones), which would count twice; leave one of them out"
                )


def _place(
    facts: Sequence[MapFacts], given: Mapping[int, Float64], store: Store, run: Run, stage: Stage
) -> list[Placed]:
    """Where each map lies: as given, or where most places agree with a map whose place is known.

    Raises:
        MapError: a map fits nowhere.
    """
    known: dict[int, tuple[Float64, TileSource, str]] = {}
    for n, T in given.items():
        known[n] = (T, _source(facts[n], T, "given"), f"{facts[n].name}: as given")
    if not known:
        known[0] = (np.eye(4), _source(facts[0], np.eye(4), "first"), f"{facts[0].name}: its world is that of the map")
    tried: dict[tuple[int, int], Alignment] = {}
    while missing := [n for n in range(len(facts)) if n not in known]:
        pairs = [(a, b) for b in missing for a in sorted(known) if (a, b) not in tried]
        if not pairs:
            break
        jobs = [(store.url, facts[a].url, facts[b].url, facts[a].digest, facts[b].digest) for a, b in pairs]
        with stage("align", len(jobs), "pairs") as bar:
            tried.update(zip(pairs, run(_align, jobs, bar.advance), strict=True))
        found: dict[int, tuple[int, Alignment]] = {}
        for (a, b), alignment in sorted(tried.items()):
            best = found.get(b)
            if b in missing and alignment.T_map_other and (best is None or alignment.agreeing > best[1].agreeing):
                found[b] = (a, alignment)
        for b, (a, alignment) in found.items():
            T = known[a][0] @ np.array(alignment.T_map_other)
            note = f"{facts[b].name}: {alignment.agreeing} of {alignment.looked_for} places found in {facts[a].name}"
            known[b] = (T, _source(facts[b], T, "found"), note)
    if missing:
        reasons = [
            f"{facts[b].name} beside {facts[a].name}: {alignment.refusal}"
            for (a, b), alignment in sorted(tried.items())
            if b in missing
        ]
        names = ", ".join(facts[n].name for n in missing)
        raise MapError(
            f"{names}: where it lies is not known; leave it out, or give its pose (--poses). {'; '.join(reasons)}"
        )
    peak = max((alignment.peak_bytes for alignment in tried.values()), default=0)
    return [Placed(facts[n], known[n][1], known[n][2], peak) for n in range(len(facts))]


def _source(facts: MapFacts, T_world_map: Float64, placed: Any) -> TileSource:
    rows: Any = tuple(tuple(float(x) for x in row) for row in T_world_map)
    return TileSource(name=facts.name, digest=facts.digest, frames=facts.header.frames, T_world_map=rows, placed=placed)


# Tasks: each may run anywhere, and again


def _caught(function: Callable[..., _R], job: tuple[Any, ...]) -> tuple[_R | None, SemanticMapperError | None]:
    """Our own errors are results, so that they arrive as they are."""
    try:
        return function(*job), None
    except SemanticMapperError as error:
        return None, error


def _read_facts(url: str, name: str) -> MapFacts:
    with _local(url) as path, open_map(path) as reader:
        with path.open("rb") as file:
            check_result_file(url, hashlib.file_digest(file, "sha256").hexdigest())
        places = frozenset(
            hashlib.sha256(f"{p.camera_id} {p.stamp_ns} ".encode() + p.descriptors.tobytes()).digest()
            for p in reader.places()
            if len(p.descriptors)
        )
        return MapFacts(url, name, content_digest(reader.manifest), reader.manifest, places)


def _align(store_url: str, url: str, other_url: str, digest: str, other_digest: str) -> Alignment:
    store = open_store(store_url)
    name = f"alignments/{digest[:16]}-{other_digest[:16]}-{MERGE_VERSION}.json"
    if store.exists(name):
        return msgspec.json.decode(store.read(name), type=Alignment)
    with _local(url) as path, _local(other_url) as other_path:
        one, other = load_to_cut(path), load_to_cut(other_path)
        try:
            found = find_alignment(one, other, _WAY_OUT)
        except MapError as error:
            alignment = Alignment(None, refusal=str(error), peak_bytes=_peak_bytes())
        else:
            rows: Any = tuple(tuple(float(x) for x in row) for row in found.T_map_other)
            alignment = Alignment(rows, found.agreeing, found.looked_for, "", _peak_bytes())
    store.write(name, msgspec.json.encode(alignment))
    return alignment


def _cut(store_url: str, url: str, source: TileSource, edge_blocks: int) -> _Cut:
    store = open_store(store_url)
    key = _digest([MERGE_VERSION, source.digest, source.T_world_map, edge_blocks])[:32]
    done = f"pieces/{key}/pieces.json"
    if store.exists(done):
        return _Cut(key, msgspec.json.decode(store.read(done), type=tuple[TileIndex, ...]), 0)
    reached: list[TileIndex] = []
    with _local(url) as path:
        voxel_map = load_to_cut(path)
        for piece in cut_map(voxel_map, np.array(source.T_world_map), edge_blocks):
            with _writing(store, f"pieces/{key}/{_name_of(piece.index)}.npz") as file:
                if write_piece(file, piece, voxel_map, edge_blocks):
                    reached.append(piece.index)
    store.write(done, msgspec.json.encode(reached))
    return _Cut(key, tuple(reached), _peak_bytes())


def _fuse(
    store_url: str, plan: str, index: TileIndex, pieces: Sequence[str], header: MapManifest, edge_blocks: int
) -> _Fused:
    store = open_store(store_url)
    name = f"tiles/{_name_of(index)}-{plan[:12]}"
    if store.exists(f"{name}.json"):
        row = msgspec.json.decode(store.read(f"{name}.json"), type=TileRow)
        if not row.blocks or store.exists(row.file):
            return _Fused(row, 0)
    with ExitStack() as stack:
        tile = fuse_pieces([stack.enter_context(_reading(store, piece)) for piece in pieces], header)
    blocks, surface = describe_tile(tile, index, edge_blocks)
    row = TileRow(index=index, file=f"{name}.npz", digest="", blocks=blocks, surface=surface)
    if blocks:  # else only its border holds something, which is inside of its neighbours
        with _writing(store, row.file) as file:
            tile.save(file)
            row = msgspec.structs.replace(row, digest=tile_digest(file))
    store.write(f"{name}.json", msgspec.json.encode(row))
    return _Fused(row, _peak_bytes())


# The store


def _there(store: Store, plan: str) -> TileManifest:
    """The tiles that a store has.

    Raises:
        ConfigError: they are of other maps.
    """
    manifest = parse_tiles(store.read(TILES_NAME), f"{store.shown}/{TILES_NAME}")
    if manifest.plan != plan:
        names = ", ".join(source.name for source in manifest.sources)
        raise ConfigError(
            f"{store.shown}: has tiles of other maps ({names}), places or tile sizes; choose another --out"
        )
    return manifest


def _lost_tiles(store: Store, manifest: TileManifest) -> set[TileIndex]:
    """Tiles of the manifest whose files are not there; in a local store, also those in whose place others are."""
    there = set(store.names("tiles"))
    lost = {row.index for row in manifest.tiles if row.file.removeprefix("tiles/") not in there}
    if store.local is None:
        return lost
    for row in manifest.tiles:
        if row.index not in lost and not _is_tile(store.local / row.file, row):
            store.remove(row.file)
            lost.add(row.index)
    return lost


def _is_tile(file: Path, row: TileRow) -> bool:
    try:
        check_tile(row, tile_digest(file))
    except MapError as error:
        _log.warning("tile_not_used", file=str(file), reason=str(error))
        return False
    return True


def _remove_scraps(store: Store, manifest: TileManifest) -> None:
    """What only a running merge needs."""
    store.remove("pieces", folder=True)
    kept = {row.file for row in manifest.tiles}
    for name in store.names("tiles"):
        if f"tiles/{name}" not in kept:
            store.remove(f"tiles/{name}")


@contextmanager
def _local(url: str) -> Iterator[Path]:
    """A map as a local file."""
    fs, path = split_url(url)
    if "file" in fs.protocol:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / MAP_NAME
        try:
            persistently(lambda: fs.get_file(path, str(file)), shown(url))
        except FileNotFoundError as error:
            raise MapError(f"{shown(url)}: no such map file") from error
        yield file


@contextmanager
def _reading(store: Store, name: str) -> Iterator[Path]:
    if store.local is not None:
        yield store.local / name
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "piece.npz"
        store.download(name, file)
        yield file


@contextmanager
def _writing(store: Store, name: str) -> Iterator[Path]:
    """Where a file is to be written, in one step, or not at all; then it is in the store."""
    if store.local is not None:
        (store.local / name).parent.mkdir(parents=True, exist_ok=True)
        yield store.local / name
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "part.npz"
        yield file
        if file.exists():
            store.upload(file, name)


def _name_of(index: TileIndex) -> str:
    return "_".join(map(str, index))


def _digest(values: Iterable[Any]) -> str:
    return hashlib.sha256(msgspec.json.encode(list(values))).hexdigest()


def _peak_bytes() -> int:
    """Most memory that this process has held (``VmHWM``); 0 where the system does not say."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)
