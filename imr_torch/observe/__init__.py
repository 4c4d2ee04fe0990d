"""Observations: landmarks, noise, and experiments as dimensionless batches; beside what reads files."""

from imr_torch.observe.collapse import CollapseShot, CollapseTime, load_collapse_times
from imr_torch.observe.convert import load_set, to_experiment
from imr_torch.observe.experiments import Experiment, ExperimentBatch, Film
from imr_torch.observe.extremes import collapse_time
from imr_torch.observe.laboratory import SimulatedLaboratory
from imr_torch.observe.landmarks import Landmarks, find_landmarks
from imr_torch.observe.medium import UNSTATED_SDS, GelMedium, gel_medium
from imr_torch.observe.noise import Noise, NoiseLaws
from imr_torch.observe.nuisance import NUISANCES, Nuisance, displaced
from imr_torch.observe.plausibility import check_experiment, check_maximum
from imr_torch.observe.prediction import predict
from imr_torch.observe.prepare import Prepared, prepare
from imr_torch.reading import (
    KNOWN_LAYOUTS,
    READERS,
    SUFFIXES,
    Given,
    Layout,
    Override,
    RadiusTrace,
    Reader,
    Statement,
    TraceSet,
    find_files,
    load_traces,
    register_reader,
    state,
)

__all__ = [
    "KNOWN_LAYOUTS",
    "NUISANCES",
    "READERS",
    "SUFFIXES",
    "UNSTATED_SDS",
    "CollapseShot",
    "CollapseTime",
    "Experiment",
    "ExperimentBatch",
    "Film",
    "GelMedium",
    "Given",
    "Landmarks",
    "Layout",
    "Noise",
    "NoiseLaws",
    "Nuisance",
    "Override",
    "Prepared",
    "RadiusTrace",
    "Reader",
    "SimulatedLaboratory",
    "Statement",
    "TraceSet",
    "check_experiment",
    "check_maximum",
    "collapse_time",
    "displaced",
    "find_files",
    "find_landmarks",
    "gel_medium",
    "load_collapse_times",
    "load_set",
    "load_traces",
    "predict",
    "prepare",
    "register_reader",
    "state",
    "to_experiment",
]
