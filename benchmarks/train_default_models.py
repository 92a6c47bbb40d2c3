"""Train the shipped models again, from the train split of the CMU data, and say whether they come out as shipped.

    python benchmarks/train_default_models.py ../shared/data [--write]

With --write the models in the package are replaced by what was trained.
"""

import sys
import tempfile
from pathlib import Path

from jaxmocap.bench.data import data_folder, train_corpus
from jaxmocap.codecs import load_artifact
from jaxmocap.codecs.artifact import shipped_models
from jaxmocap.training import TRAINERS

# Lossy codecs learn without the T-pose, archives have to keep it.
STARTS = {"lsdt-clip": 1, "lsdt-frame": 1, "dct-frame": 1, "exact": 0, "learned": 1, "live": 1}
MODELS = Path(__file__).resolve().parents[1] / "jaxmocap" / "models"


def main() -> int:
    arguments = [a for a in sys.argv[1:] if a != "--write"]
    data = data_folder(Path(arguments[0]) if arguments else None)
    same = True
    for name, train in TRAINERS.items():
        corpus = train_corpus(data, STARTS[name])
        with tempfile.TemporaryDirectory() as folder:
            artifact, report = train(corpus, Path(folder) / "partial")
        shipped = load_artifact(name).digest if name in shipped_models() else "none"
        print(f"{name}: {report['files']} files, {report['frames']} frames\n  trained {artifact.digest}\n  shipped {shipped}")
        same &= artifact.digest == shipped
        if "--write" in sys.argv:
            (MODELS / f"{name}.safetensors").write_bytes(artifact.data)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
