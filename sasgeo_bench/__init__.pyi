# SPDX-License-Identifier: Apache-2.0
# The public names, and where each comes from: for type checkers, and for `lazy_loader`, which reads them here.

from .bounds import MOST_CANDIDATES as MOST_CANDIDATES
from .cli.boards import score as score
from .cli.publishing import publish as publish
from .cli.queries import make_tasks as make_tasks
from .cli.regions import build_region as build_region
from .cli.runs import run as run
from .geometry.grid import Grid as Grid
from .geometry.pose import Pose as Pose
from .geometry.pose import Prior as Prior
from .geometry.pose import inverse as inverse
from .matching.matcher import WITHHELD as WITHHELD
from .matching.matcher import Learner as Learner
from .matching.matcher import Match as Match
from .matching.matcher import Matcher as Matcher
from .matching.matcher import MatcherCard as MatcherCard
from .matching.matcher import Training as Training
from .matching.plugins import load_matcher as load_matcher
from .matching.plugins import load_rejector as load_rejector
from .matching.rejector import Rejector as Rejector
from .matching.rejector import RejectorCard as RejectorCard
from .matching.results import Prediction as Prediction
from .osm.features import make_features as make_features
from .osm.taxonomy import load_taxonomy as load_taxonomy
from .regions.evidence import ABSENT as ABSENT
from .regions.evidence import PRESENT as PRESENT
from .regions.evidence import UNKNOWN as UNKNOWN
from .regions.evidence import Evidence as Evidence
from .regions.evidence import LayerBits as LayerBits
from .regions.evidence import observe as observe
from .regions.graph import build_graph as build_graph
from .regions.region import MapGraph as MapGraph
from .regions.region import Region as Region
from .regions.region_files import read_region as read_region
from .running.prediction_files import read_predictions as read_predictions
from .running.prediction_rows import PREDICTION_SCHEMA as PREDICTION_SCHEMA
from .running.testing import TinyPlace as TinyPlace
from .running.testing import check_matcher as check_matcher
from .running.testing import tiny_place as tiny_place
from .tasks.query import Query as Query
from .tasks.query import Truth as Truth
from .tasks.task_files import read_queries as read_queries
from .tasks.task_files import read_task as read_task
from .tasks.task_files import read_truths as read_truths

__version__: str
