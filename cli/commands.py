"""The table of commands.

Each row names a function of a module of this room, which is imported when the command runs: `--help` imports nothing
heavy. Those modules are where rooms meet. The commands that measure the project are in `measurements`.
"""

from __future__ import annotations

from spike4dgs.cli.command import Command
from spike4dgs.cli.measurements import MEASUREMENTS

# Headings of --help, in its order -> the commands below them, by their first words.
GROUPS: dict[str, str] = {
    "Make data": "make-dataset worlds verify calibrate",
    "Run and score": "run-benchmark methods score fit fault-table",
    "Leaderboard": "leaderboard submit verify-leaderboard season",
    "Look": "inspect images render view",
    "Recorder": "record board-clip calibrate-rig",
    "Exchange": "import-dat import-frames import-spikecv export-spikecv export-nerfstudio export-colmap export-ply "
    "download release",
    "Train": "make-msdi-data train-msdi train-spk2img",
    "Measure": "report speed poses patterns spike-agreement",
    "This machine": "doctor completion",
}

COMMANDS: dict[str, Command] = {
    "make-dataset": Command(
        "spike4dgs.cli.make_dataset:make_dataset",
        "render worlds and simulate their spike cameras",
        "make-dataset --all --profile small --out data",
        seed_bits=128,  # those of a season
    ),
    "worlds": Command(
        "spike4dgs.cli.worlds:worlds",
        "list the worlds: speeds, moving pixels, depths, key spacing",
        "worlds",
    ),
    "calibrate": Command(
        "spike4dgs.cli.calibrate:calibrate",
        "estimate gain and dark maps from the flat-field and dark recordings",
        "calibrate data/car-0-small",
    ),
    "record": Command(
        "spike4dgs.cli.record:record",
        "record the cameras of an array over USB, or emulated ones, as a scene folder",
        "record rig.toml --seconds 0.5 --out captures/first",
    ),
    "board-clip": Command(
        "spike4dgs.cli.board_clip:board_clip",
        "simulate a moving chessboard in front of an array, to try record and calibrate-rig",
        "board-clip --out runs/board --seconds 1",
    ),
    "calibrate-rig": Command(
        "spike4dgs.cli.calibrate_rig:calibrate_rig",
        "find an array's intrinsics and poses from clips of a moving chessboard",
        "calibrate-rig captures/board --columns 8 --rows 5 --square-m 0.04 --out rig",
    ),
    "train-spk2img": Command(
        "spike4dgs.cli.train_spk2img:train_spk2img",
        "train Spk2ImgNet on training variants of the worlds",
        "train-spk2img --scenes data/car-1-small data/bricks-1-small --hidden data/bricks-2-small --out runs/spk2img",
    ),
    "make-msdi-data": Command(
        "spike4dgs.cli.make_msdi_data:make_msdi_data",
        "render training data for MSDI: many variants of the worlds, seen by many rigs",
        "make-msdi-data --variants 40 --out data/msdi",
    ),
    "train-msdi": Command(
        "spike4dgs.cli.train_msdi:train_msdi",
        "train the network that estimates points, poses and images from spikes",
        "train-msdi --data data/msdi --out runs/msdi",
    ),
    "run-benchmark": Command(
        "spike4dgs.cli.run_benchmark:run_benchmark",
        "fit methods on scenes, score them, and enter them into a leaderboard",
        "run-benchmark data/car-0-small data/turntable-0-small --methods tfp+4dgs --out runs/small --seed 0",
    ),
    "methods": Command(
        "spike4dgs.cli.methods:methods",
        "list the installed methods with their parts, or describe one with its settings",
        "methods",
    ),
    "fit": Command(
        "spike4dgs.cli.fit:fit",
        "fit a model to a recording without ground truth; write a sheet, a video and a report",
        "fit captures/turntable --out runs/turntable",
    ),
    "fault-table": Command(
        "spike4dgs.cli.studies:fault_table",
        "degrade captures of a scene on purpose, fit them, and tabulate the dB lost",
        "fault-table data/turntable-0-small --out runs/faults",
    ),
    "score": Command(
        "spike4dgs.cli.score:score",
        "score a predictions folder from any program",
        "score runs/small/predictions/tfp+4dgs data/car-0-small data/turntable-0-small --out r.json",
    ),
    "submit": Command(
        "spike4dgs.cli.submit:submit",
        "verify a result record and enter it into a leaderboard",
        "submit r.json --predictions runs/small/predictions/tfp+4dgs --scenes data/car-0-small data/turntable-0-small",
    ),
    "verify-leaderboard": Command(
        "spike4dgs.cli.verify_leaderboard:verify_leaderboard",
        "check a leaderboard's release, entries and boards",
        "verify-leaderboard leaderboard",
    ),
    "leaderboard": Command(
        "spike4dgs.cli.leaderboard:show", "print the ranking of the tracks, with rank intervals and ties", "leaderboard"
    ),
    "leaderboard build": Command(
        "spike4dgs.cli.leaderboard:build",
        "write the leaderboard as a page of files, with your runs among the entries",
        "leaderboard build",
    ),
    "season make": Command(
        "spike4dgs.cli.season:make",
        "draw secret seeds, make hidden scenes, and write the commitments to them",
        "season make 1 --worlds car turntable --secret ~/season-1",
    ),
    "season publish": Command(
        "spike4dgs.cli.season:publish",
        "write tars of what may be public so far: training parts, and whole scenes after the reveal",
        "season publish 1 --secret ~/season-1 --out public",
    ),
    "season predict": Command(
        "spike4dgs.cli.season:predict",
        "fit methods on published training parts and render the targets, to submit them",
        "season predict car-9001-small turntable-9001-small --methods tfp+4dgs --out runs/season-1",
    ),
    "season score": Command(
        "spike4dgs.cli.season:score",
        "score submitted predictions, or run methods and score them",
        "season score 1 --secret ~/season-1 --predictions received/theirs --methods tfp+4dgs",
    ),
    "season reveal": Command(
        "spike4dgs.cli.season:reveal",
        "publish the secret seeds of a season that is over",
        "season reveal 1 --secret ~/season-1",
    ),
    "season check": Command(
        "spike4dgs.cli.season:check",
        "check the seeds, scenes and scores of a season against its commitments",
        "season check 0",
    ),
    "inspect": Command(
        "spike4dgs.cli.inspect:inspect",
        "show a scene or a raw spike stream: rates, bad pixels, images",
        "inspect recording.dat --width 400 --height 250 --rate-hz 20000",
    ),
    "images": Command(
        "spike4dgs.cli.images:images",
        "make images of a raw stream or a scene: PNG, EXR and a slow-motion video",
        "images recording.dat --width 400 --height 250 --rate-hz 20000 --method tfi --every 20 --out runs/recording",
    ),
    "render": Command(
        "spike4dgs.cli.render:render",
        "make a slow-motion video of a fitted model",
        "render runs/small/models/tfp+4dgs/car-0-small.safetensors --path orbit --slow-motion 1000 --out car.mp4",
    ),
    "view": Command(
        "spike4dgs.cli.view:view",
        "show a fitted model in the browser",
        "view runs/small/models/tfp+4dgs/car-0-small.safetensors --scene data/car-0-small",
    ),
    "doctor": Command(
        "spike4dgs.cli.doctor:doctor", "report what this machine has, what it lacks, and how to fix it", "doctor"
    ),
    "download": Command(
        "spike4dgs.cli.download:download",
        "fetch the scenes of a track or a release, or parts of them",
        "download ideal --from https://example.org/spike4dgs/2 --out data",
    ),
    "download weights": Command(
        "spike4dgs.cli.download_weights:download_weights",
        "fetch weight files for metrics and methods, their licences shown first",
        "download weights lpips",
    ),
    "release pack": Command(
        "spike4dgs.cli.release:pack",
        "pack scenes into a release that people can download",
        "release pack data/car-0-small data/turntable-0-small --out releases/2",
    ),
    "release check": Command(
        "spike4dgs.cli.release:check",
        "check a release: a host's limits, the index, every byte",
        "release check releases/2",
    ),
    "release publish": Command(
        "spike4dgs.cli.release:publish",
        "upload a release to Zenodo, Hugging Face or a web server; --dry-run shows what would be sent",
        "release publish releases/2-flat --to zenodo-sandbox --dry-run",
    ),
    "release wheel": Command(
        "spike4dgs.cli.release:wheel",
        "write a wheel of a small release, so that pip can install its scenes",
        "release wheel releases/quick-start --out dist",
    ),
    "release fingerprint": Command(
        "spike4dgs.cli.release:fingerprint",
        "write small files that identify scenes made on other processors",
        "release fingerprint data/car-0-small --out leaderboard/releases/2",
    ),
    "verify": Command(
        "spike4dgs.cli.verify:verify",
        "check every file of a scene against its manifest",
        "verify data/car-0-small",
    ),
    "import-dat": Command(
        "spike4dgs.cli.import_dat:import_dat",
        "make a folder of streams or a scene from bare .dat files, with cameras from COLMAP, OpenCV or Kalibr",
        "import-dat recordings --width 400 --height 250 --rate-hz 20000 --cameras camchain.yaml --out data/first",
    ),
    "import-frames": Command(
        "spike4dgs.cli.import_frames:import_frames",
        "make a scene from the footage of an array of ordinary cameras, with each instant held still",
        "import-frames footage --cameras cameras.yml --held-out cam_1 --width 240 --out data/first",
    ),
    "import-spikecv": Command(
        "spike4dgs.cli.spikecv:import_spikecv",
        "make a scene folder from a SpikeCV folder",
        "import-spikecv motVidarReal2020/rotation1 --out data/rotation1 --rate-hz 20000",
    ),
    "export-spikecv": Command(
        "spike4dgs.cli.spikecv:export_spikecv",
        "write a scene's streams as a SpikeCV folder",
        "export-spikecv data/car-0-small --out car-spikecv",
    ),
    "poses": Command(
        "spike4dgs.cli.studies:poses",
        "estimate the training cameras' poses and measure their errors",
        "poses data/car-0-small data/bricks-0-small --initialization colmap",
    ),
    "patterns": Command(
        "spike4dgs.cli.studies:patterns",
        "estimate the cameras' gain and dark maps from the clip alone, and measure their errors",
        "patterns data/car-0-small",
    ),
    "export-nerfstudio": Command(
        "spike4dgs.cli.export_nerfstudio:export_nerfstudio",
        "write images, poses and times for nerfstudio's parsers and nerfbaselines",
        "export-nerfstudio data/car-0-small --out car-nerfstudio",
    ),
    "export-colmap": Command(
        "spike4dgs.cli.export_colmap:export_colmap",
        "write images from a scene's spikes with a COLMAP model",
        "export-colmap data/car-0-small --out car-colmap",
    ),
    "export-ply": Command(
        "spike4dgs.cli.export_ply:export_ply",
        "write a model's Gaussians at several times as .ply files for other viewers",
        "export-ply runs/small/models/tfp+4dgs/car-0-small.safetensors --times 30 --out car-ply",
    ),
    **MEASUREMENTS,
    "completion": Command(
        "spike4dgs.cli.completion:completion",
        "print a script that completes commands and options in bash, zsh or fish",
        "completion bash",
    ),
}
