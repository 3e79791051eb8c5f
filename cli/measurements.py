"""The commands that measure the project: each is a study's own function."""

from __future__ import annotations

from spike4dgs.cli.command import Command

MEASUREMENTS: dict[str, Command] = {
    "report speed-error": Command(
        "spike4dgs.cli.studies:speed_error",
        "compare every approximation with its exact counterpart, and measure how costs grow, on one page",
        "report speed-error --quick --out runs/speed-error",
    ),
    "report dark-poses": Command(
        "spike4dgs.cli.studies:dark_poses",
        "estimate arrays' poses in less and less light, with the matching network, SIFT and COLMAP",
        "report dark-poses data/matching --out runs/dark-poses",
    ),
    "report dark-points": Command(
        "spike4dgs.cli.studies:dark_points",
        "find points in less and less light, or of scenes, at true poses, with the matching network's cost volume and "
        "the plane sweep",
        "report dark-points data/matching --out runs/dark-points",
    ),
    "report hard-cases": Command(
        "spike4dgs.cli.studies:hard_cases",
        "check hard inputs, seeds, interrupted fits and threads against independent results, on one page",
        "report hard-cases --out runs/hard-cases",
    ),
    "report modality": Command(
        "spike4dgs.cli.studies:modality",
        "fit recordings of the same scenes by spike, frame and event cameras, and plot quality against bits per second",
        "report modality data/turntable-10-small-100ms --out runs/modality",
    ),
    "report oracle-ladder": Command(
        "spike4dgs.cli.studies:oracle_ladder",
        "fit recipes with one thing replaced by the truth, and tabulate the dB that each gains",
        "report oracle-ladder data/car-0-small --out runs/oracle",
    ),
    "report realism": Command(
        "spike4dgs.cli.studies:realism",
        "distinguish a real recording from simulated ones of equal rates: classifier, statistics, image makers' ranks",
        "report realism car.dat --width 400 --height 250 --out runs/realism",
    ),
    "report results": Command(
        "spike4dgs.cli.studies:results",
        "measure what the published tables show, keep a record of each cell, and write the tables from the records",
        "report results --scenes-of data/ideal",
    ),
    "report scene-noise": Command(
        "spike4dgs.cli.studies:scene_noise",
        "tabulate the rendering noise of audited scenes, and the ceilings of their scores",
        "report scene-noise data --out runs/noise",
    ),
    "report second-renderer": Command(
        "spike4dgs.cli.studies:second_renderer",
        "render one tick of three worlds with Cycles too, and tabulate how much and why it differs",
        "report second-renderer --out runs/second-renderer",
    ),
    "report tuning": Command(
        "spike4dgs.cli.studies:tuning",
        "search for better settings of recipes on development scenes, with the same search for every row",
        "report tuning data/van-10-small data/turntable-10-small --rows tfp+stg spike4dgs-x --out runs/tuning",
    ),
    "spike-agreement": Command(
        "spike4dgs.cli.studies:spike_agreement",
        "report how well a held-out camera's own spikes rank methods, compared with PSNR",
        "spike-agreement runs/small --data data --out runs/spike-agreement",
    ),
    "speed render": Command(
        "spike4dgs.cli.studies:render",
        "render images of saved models, side by side",
        "speed render runs/small/models/*/car-0-small.safetensors",
    ),
    "speed record": Command(
        "spike4dgs.cli.studies:record",
        "record emulated cameras into memory and to disk, with queued and single reads",
        "speed record",
    ),
    "speed images": Command(
        "spike4dgs.cli.studies:images",
        "measure the time and quality of each way to make an image from spikes, next to the paper's table 6",
        "speed images data/car-0-small data/turntable-0-small",
    ),
}
