"""Scoring a result with landmarks: target registration errors per phase, by depth, and the nodule's own error."""

from vatsloc.evaluation.evaluate import Evaluation, evaluate, evaluate_case
from vatsloc.evaluation.inputs import Result, Truth, read_result, read_truth
from vatsloc.evaluation.table import table

__all__ = ["Evaluation", "Result", "Truth", "evaluate", "evaluate_case", "read_result", "read_truth", "table"]
