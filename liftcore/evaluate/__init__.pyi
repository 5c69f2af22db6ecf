"""The names of liftcore.evaluate, and where they live."""

from liftcore.evaluate.check import CheckReport as CheckReport
from liftcore.evaluate.check import check_scene as check_scene
from liftcore.evaluate.evaluation import Evaluation as Evaluation
from liftcore.evaluate.evaluation import evaluate_lift as evaluate_lift
from liftcore.evaluate.inspect import inspect_file as inspect_file
from liftcore.evaluate.tradeoff import SceneFiles as SceneFiles
from liftcore.evaluate.tradeoff_report import compare_speeds as compare_speeds

__all__: list[str]
