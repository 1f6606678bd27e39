import numpy as np
from made_trials import write_trials

from adaptune import files
from offline.charts import read_trials
from offline.config import load_study


def test_a_study_is_read(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    assert not len(read_trials(study))
    write_trials(study, lambda _, p: p["keyframe_interval"], 5)
    table = read_trials(study)
    intervals = table.column("keyframe_interval")
    np.testing.assert_allclose(table.values, intervals, rtol=1e-6)
    assert table.fixed is None
    (study.folder / "fixed.yaml").write_text(files.dump(table.sets[2]), "utf-8")
    assert read_trials(study).fixed == 2
