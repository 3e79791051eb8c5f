"""The commands that measure the project: each is a study's own function."""

from __future__ import annotations

from spike4dgs.studies.faults import fault_table as fault_table
from spike4dgs.studies.hard_cases import hard_cases as hard_cases
from spike4dgs.studies.images import images as images
from spike4dgs.studies.modality.command import modality as modality
from spike4dgs.studies.oracle_ladder import oracle_ladder as oracle_ladder
from spike4dgs.studies.patterns import patterns as patterns
from spike4dgs.studies.poses.dark import dark_poses as dark_poses
from spike4dgs.studies.poses.estimators import poses as poses
from spike4dgs.studies.poses.points import dark_points as dark_points
from spike4dgs.studies.realism.command import realism as realism
from spike4dgs.studies.recorder import record as record
from spike4dgs.studies.results.command import results as results
from spike4dgs.studies.saved_models import render as render
from spike4dgs.studies.scene_noise import scene_noise as scene_noise
from spike4dgs.studies.second_renderer.command import second_renderer as second_renderer
from spike4dgs.studies.speed_error.command import speed_error as speed_error
from spike4dgs.studies.spike_agreement import spike_agreement as spike_agreement
from spike4dgs.studies.tuning.search import tuning as tuning
