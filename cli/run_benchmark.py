"""`run-benchmark`: run methods on scenes, then write the table, the sheets and the leaderboard's entries.

Besides what `run` keeps, OUT has results.csv, sheet_SCENE.{png,pdf,mp4}, scatter.{png,pdf}, leaderboard/ and, for a
table of the paper, table.*. Records that earlier runs left in OUT on the same scenes are in all of these. Images and
tables of the paper show the first seed; results.csv and the leaderboard have all of them. A run on another split than
the default one keeps all this in OUT/SPLIT/, and so does a table that compares splits.

With `--oracle` it climbs a ladder of oracles instead (`oracle.ladder`), whose records go into no leaderboard.

Submitting a record, measuring images from spikes, oracles and their truth are the work of other rooms, which this one
does not import: the command line passes the functions in.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rich.console import Console
from tyro.conf import Positional

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Method, find_methods, make_budget
from spike4dgs.benchmark.metrics.selection import AUTO, select_metrics
from spike4dgs.benchmark.release.download_command import From
from spike4dgs.benchmark.release.track import track_folders
from spike4dgs.benchmark.reports.console import make_console, results_table
from spike4dgs.benchmark.reports.paper_files import in_every_split, write_paper_table
from spike4dgs.benchmark.reports.paper_tables import IMAGE_TABLE, POSES, PublishedTable, published, table_scenes
from spike4dgs.benchmark.runs.earlier import earlier_records, of_one_seed, write_results
from spike4dgs.benchmark.runs.images import write_images
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.studies.oracle.ladder import SAMPLES, FindTruth, MakeLadders, climb


class Submit(Protocol):
    """Checks result records, enters them into a leaderboard and prints their ranks."""

    def __call__(
        self,
        results: Mapping[Path, Path | None],
        *,
        scenes: tuple[Path, ...],
        leaderboard: Path,
        replace: bool,
        allow_gaps: bool,
    ) -> int:
        """Submit the records in the files `results`, with their predictions; return how many were refused."""
        ...


@dataclass(frozen=True)
class RunBenchmark:
    """The command, and the functions of other rooms that it calls."""

    submit: Submit
    measure_images: Callable[[Sequence[str]], int]  # the command line of `speed images`, which makes table 6
    track_scenes: Callable[[str], dict[str, str]]  # the revisions of a track's scenes by their ids
    make_ladders: MakeLadders
    find_truth: FindTruth  # what a ladder's oracles are given

    def run_benchmark(
        self,
        scenes: Positional[tuple[Path, ...]] = (),
        *,
        table: int | None = None,
        poses: str = POSES[0],
        track: str | None = None,
        source: From = None,
        data: Path = Path("data"),
        profile: str = "small",
        methods: tuple[str, ...] = (),
        out: Path = Path("runs/benchmark"),
        seed: int = 0,
        seeds: int = 1,
        workers: int = 1,
        scheduler: str | None = None,
        device: str = "auto",
        budget: str = "quick",
        metrics: tuple[str, ...] = (AUTO,),
        split: str | None = None,
        leaderboard: Path | None = None,
        replace: bool = False,
        allow_gaps: bool = False,
        oracle: bool = False,
        oracle_samples: int = SAMPLES,
    ) -> int:
        """Fit methods on scenes, score them, and enter them into a leaderboard. A killed run resumes where it was.

        A run with other methods on the same scenes in the same folder adds them to the table and the sheets.

        Args:
            scenes: Scene folders.
            table: Instead of scenes, a table of the paper: 1 (outdoor), 2 (objects), 3 (components), 4 (supervision), 5
                (number of views; plotted in views.png), 6 (images from spikes), 7 (MSDI without SPSS).
            poses: Of table 1 or 2: given (methods get the rig's poses) or estimated (each estimates its own).
            track: Instead of scenes, a track such as outdoor-small: its scenes in DATA; those that are missing are
                downloaded.
            source: Where the release with the track's scenes lies; SPIKE4DGS_RELEASE if left out.
            data: Folder of the table's or track's scenes.
            profile: Profile of the table's scenes.
            methods: Methods by name; all that are installed, or all rows of the table, if left out.
            out: Folder for predictions, results, images and logs; for another split than the default, OUT/SPLIT is.
            seed: Seed that every fit gets.
            seeds: Number of seeds, from that one up. The table shows means over them; what belongs to a further seed K
                is in OUT/seed-K.
            workers: Processes that fit, each on its share of this machine's cores.
            scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers fit. They read the scenes
                at the same paths.
            device: auto, cpu or cuda. auto looks at this machine, also for the workers of a scheduler.
            budget: quick, standard (4 times the steps), paper (each publication's steps), or a multiple of quick.
            metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal
                error are always computed.
            split: Training views and held-out views, such as corner or views-3; each scene's default if left out.
            leaderboard: Leaderboard folder to submit to; OUT/leaderboard if left out.
            replace: Replace entries of the same name in that leaderboard.
            allow_gaps: Accept recordings with gaps.
            oracle: Climb a ladder instead: each method as it is, then with the true images, points, velocities or
                calibration, with more Gaussians, with more steps. METHODS are recipes, spike4dgs-x if left out; the
                scenes are made ones. OUT gets ladder.md, ladder.csv and ladder_METHOD.png, and no leaderboard.
            oracle_samples: Samples per pixel of the true images, a power of two.
        """
        if poses != POSES[0] and table in (None, IMAGE_TABLE):
            fix = "without a table, name the methods, such as tfp+colmap+4dgs"
            raise problem("--poses", "--table 1 or 2 beside it", f"--table {table}" if table else "no table", fix)
        if table == IMAGE_TABLE:
            return self._measure_images(scenes, data, profile, out, allow_gaps)
        paper = None if table is None else published(table, poses)
        if paper and scenes:
            raise problem("--table", "no scene folders beside it", str(scenes[0]), "use --data and --profile")
        if track is not None:
            scenes = self._track_folders(track, scenes, table, data, source)
        scenes = table_scenes(paper, data, profile) if paper else scenes
        if oracle:
            _check_no_entries(table, leaderboard, replace)
        chosen = [] if oracle else _choose_methods(methods, paper)
        if scheduler is None or device == "auto":
            device = choose_device(device, rasterizes=any(getattr(m, "rasterizes", True) for m in chosen))
        console = make_console()
        common = (seed, device, make_budget(budget), metrics, seeds, workers, scheduler)
        if oracle:
            opened = open_scenes(scenes, allow_gaps, split)
            settings = Settings(_folder_of_split(out, split, opened), *common)
            return self._climb(opened, methods, oracle_samples, settings, console)
        splits = paper.splits if paper and paper.splits and split is None else (split,)
        runs, submissions = [], []
        for name in splits:
            opened = open_scenes(scenes, allow_gaps, name)
            folder = _folder_of_split(out, name, opened)
            settings = Settings(folder, *common)
            records = run_matrix(opened, chosen, settings, console)
            earlier, left_out = earlier_records(folder, records)
            for line in left_out:
                _say(console, f"not in the table: {line}")
            console.print(results_table([*earlier, *records]))
            for line in write_images(opened, of_one_seed([*earlier, *records]), folder):
                _say(console, line)
            write_results(folder / "results.csv", [*earlier, *records])
            _say(console, f"images: {folder}/sheet_*.png and {folder}/scatter.png; values: {folder}/results.csv")
            _say(console, f"for papers and slides: the same as .pdf, and {folder}/sheet_*.mp4")
            submissions.append((records, settings))
            rows = paper.rows if paper else ()
            runs.append((opened, of_one_seed([*(r for r in earlier if plain_name(r) in rows), *records])))
        if paper:
            folder = out if len(runs) > 1 else folder
            worlds = {path.name: world for path, world in zip(scenes, paper.worlds, strict=True)}
            write_paper_table(paper, in_every_split(runs), worlds, select_metrics(metrics).metrics, folder)
            _say(console, f"table {paper.number}: {folder}/table.md, .csv, .tex, .json")
        refused = [
            self._submit(records, scenes, settings, leaderboard, replace, allow_gaps)
            for records, settings in submissions
        ]
        return _say_failed(_failed_cells([r for records, _ in submissions for r in records])) or int(any(refused))

    def _climb(
        self, scenes: Sequence[Scene], names: Sequence[str], samples: int, settings: Settings, console: Console
    ) -> int:
        """Climb the ladders of methods; return the command's exit code."""
        truth = settings.out / "truth"
        ladders = self.make_ladders(names, truth, samples)
        records = climb(scenes, ladders, self.find_truth, truth, samples, settings, console)
        _say(console, f"ladder: {settings.out}/ladder.md, ladder.csv and ladder_*.png")
        return _say_failed(_failed_cells(records))

    def _track_folders(
        self, track: str, scenes: tuple[Path, ...], table: int | None, data: Path, source: str | None
    ) -> tuple[Path, ...]:
        """Return the scene folders of a track; what is missing is downloaded."""
        if scenes or table is not None:
            found = str(scenes[0]) if scenes else f"--table {table}"
            raise problem("--track", "neither scenes nor a table beside it", found, "use --data for the folder")
        return track_folders(self.track_scenes(track), data, source)

    def _measure_images(self, scenes: tuple[Path, ...], data: Path, profile: str, out: Path, allow_gaps: bool) -> int:
        """Make table 6, which compares images from spikes and fits no method."""
        worlds = [world for number in (1, 2) for world in published(number).worlds]
        chosen = scenes or tuple(p for world in worlds if (p := data / f"{world}-0-{profile}").is_dir())
        if not chosen:
            fix = f"spike4dgs make-dataset --all --profile {profile} --out {data}"
            raise problem(data, f"a scene WORLD-0-{profile}", "none", fix)
        gaps = ["--allow-gaps"] if allow_gaps else []
        return int(self.measure_images([*map(str, chosen), "--out", str(out), *gaps]))

    def _submit(
        self,
        records: Sequence[Record],
        scenes: tuple[Path, ...],
        settings: Settings,
        leaderboard: Path | None,
        replace: bool,
        allow_gaps: bool,
    ) -> int:
        """Submit every record. Return how many the leaderboard refused; the run's results remain."""
        names = [(settings.folder(r["method"]["seed"]), r["method"]["name"]) for r in records]
        folders = {out / "results" / f"{name}.json": out / "predictions" / name for out, name in names}
        return self.submit(
            {result: folder if folder.is_dir() else None for result, folder in folders.items()},
            scenes=scenes,
            leaderboard=leaderboard or settings.out / "leaderboard",
            replace=replace or leaderboard is None,
            allow_gaps=allow_gaps,
        )


def make_run_benchmark(
    submit: Submit,
    measure_images: Callable[[Sequence[str]], int],
    track_scenes: Callable[[str], dict[str, str]],
    make_ladders: MakeLadders,
    find_truth: FindTruth,
) -> Callable[..., int]:
    """Return the command `run-benchmark`, which calls these functions of other rooms."""
    return RunBenchmark(submit, measure_images, track_scenes, make_ladders, find_truth).run_benchmark


def _choose_methods(names: tuple[str, ...], paper: PublishedTable | None) -> list[Method]:
    """Return the methods by name; without names the rows of the table, or all that are installed."""
    known: Mapping[str, Method] = find_methods()
    names = names or (tuple(m for m in paper.rows if m in known) if paper else ())
    if unknown := [m for m in names if m not in known]:
        raise problem("--methods", f"names among {', '.join(sorted(known))}", ", ".join(unknown), "correct the names")
    if not known:
        raise problem("--methods", "an installed method", "none", "install a package that registers one")
    return [known[name] for name in dict.fromkeys(names or known)]


def _folder_of_split(out: Path, split: str | None, scenes: Sequence[Scene]) -> Path:
    """Return the folder of a run: OUT, or OUT/SPLIT for another split than the scenes' default."""
    return out / split if split and not all(s.is_default_split for s in scenes) else out


def _check_no_entries(table: int | None, leaderboard: Path | None, replace: bool) -> None:
    """Raise UserError for options that an oracle's records have no use for."""
    given = {"--table": table is not None, "--leaderboard": leaderboard is not None, "--replace": replace}
    if beside := [name for name, there in given.items() if there]:
        expected = "no table and no leaderboard beside it: they show what methods do without the truth"
        raise problem("--oracle", expected, ", ".join(beside), "leave it out")


def plain_name(record: Record) -> str:
    """Return the name of a record's method, without the mark of refined held-out views."""
    return str(record["method"]["name"]).removesuffix(SUFFIX)


def _failed_cells(records: Sequence[Record]) -> list[str]:
    cells = [(r["method"], scene, c["status"]) for r in records for scene, c in r["scenes"].items()]
    return [f"{m['name']} on {scene}, seed {m['seed']}" for m, scene, status in cells if status == "failed"]


def _say_failed(failed: Sequence[str]) -> int:
    """Print the cells that failed on stderr; return the exit code."""
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False)
