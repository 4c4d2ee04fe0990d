"""The record before any gel is fitted: what curves show without a model, and shots that stand out."""

from imr_torch.record.cycles import ALL_ALIKE, Cycle, RecordOptions
from imr_torch.record.describe import Record, ShotRecord, describe_record

__all__ = ["ALL_ALIKE", "Cycle", "Record", "RecordOptions", "ShotRecord", "describe_record"]
