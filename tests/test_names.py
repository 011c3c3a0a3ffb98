"""One name means one thing: public classes that share a name are listed with the reason."""

import ast
from collections import defaultdict
from pathlib import Path

from estune.support.garbage import collection_paused

ROOT = Path(__file__).parents[1]

SHARED = {
    "GainSet": "gains that the daemon stores; gains with which a part of a log ran",
    "Interval": "of a predicted margin; of an effect's parameter: both are low, value, high",
    "Lane": "of queries that wait at a listener; of tests, in an experiment",
    "LeftOut": "part of a log that is not used; error of a law on data it was not fitted to",
    "Prediction": "of a step response by the identified loop; of records by a plant's model",
    "Signals": "names and units of a rig's signals; the signals of a torque balance",
    "Status": "a message of the rig protocol; a coloured line of a page",
    "StribeckFriction": "law (10): what a controller compensates; what a model has",
}
"""Names of several public classes, and why each is kept."""


@collection_paused()
def class_names():
    """Files of each public class, by its name."""
    files = defaultdict(list)
    for top in ("estune", "plants", "experiments"):
        for path in sorted((ROOT / top).rglob("*.py")):
            for node in ast.parse(path.read_text("utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    files[node.name].append(str(path.relative_to(ROOT)))
    return files


def test_each_public_class_name_is_one_class_or_has_a_reason():
    shared = {name: files for name, files in class_names().items() if len(files) > 1}
    assert set(shared) <= set(SHARED), {n: shared[n] for n in set(shared) - set(SHARED)}


if __name__ == "__main__":
    for name, files in class_names().items():
        if len(files) > 1:
            print(name, *files)
