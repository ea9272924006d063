"""Files with inserted code: no reader executes the code.

Each input is a valid file with inserted code: a name to import, a tag, an expression, a format, or a pickled object.
Executed code would create a file. An audit hook of the interpreter also reports unpickled objects, started programs and
imports of the inserted name. A reader may accept the input, or refuse it with one sentence.
"""

import hashlib
import io
import json
import pickle
import runpy
import sys
import zipfile
from contextlib import contextmanager, redirect_stdout, suppress

import numpy as np
import pyarrow as pa
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fuzz.changes import edited, edits, entry_at, paths_in
from fuzz.tally import attempt, few_inputs
from fuzz.test_runs import ARRAYS, CONFIGS, DESCRIPTION, LAYERS, TABLE, VALUES
from fuzz.test_templates import TEXTS as TEMPLATES
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.models.primitives import Demonstrations
from guiderail.models.templates import parse_template
from guiderail.tools.environments import as_value, check_environment
from guiderail.tools.evaluation.step_log import read_step_log, write_step_log
from guiderail.tools.imports import import_stored
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.run_folder import RunFolder
from guiderail_data.convert import import_recording
from guiderail_hardware.robot.scenario import load_scenario
from guiderail_parts.geometry.mesh_file import load_part
from guiderail_parts.task import write_workcell
from guiderail_parts.task_file import FILE_FORMAT, read_task_file, task_folder_digest
from guiderail_studies.certificate import checker
from guiderail_studies.declaration import load_study
from guiderail_studies.study import run_study

pytest.importorskip("rosbags")
pytest.importorskip("trimesh")

MODULE = "guiderail_canary"
FORBIDDEN = ("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "subprocess.Popen")
EVENTS: list[str] = []
_is_auditing = False


def _audit(event, arguments):
    if event == "pickle.find_class" and arguments[0].split(".")[0] in ("numpy", "guiderail"):
        return  # unpickles arrays from the process that reads a mesh
    if _is_auditing and (event in FORBIDDEN or (event == "import" and MODULE in str(arguments[0]))):
        EVENTS.append(f"{event} {str(arguments)[:200]}")


sys.addaudithook(_audit)


class ExecutedOnUnpickling:
    """Object that creates the canary file when it is unpickled."""

    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return exec, (f"open({str(self.canary)!r}, 'w')",)


@pytest.fixture(scope="module")
def canary(tmp_path_factory):
    """Yield the file that executed code would create, while a module named `MODULE` is on the import path."""
    folder = tmp_path_factory.mktemp("canary")
    (folder / f"{MODULE}.py").write_text(f"open({str(folder / 'touched')!r}, 'w')\n")
    sys.path.insert(0, str(folder))
    yield folder / "touched"
    sys.path.remove(str(folder))


@contextmanager
def audit():
    """Record the events of executed code within the context."""
    global _is_auditing
    EVENTS.clear()
    _is_auditing = True
    try:
        yield
    finally:
        _is_auditing = False


def executions(canary):
    """Return the events that the last audit recorded, and the file that executed code has created."""
    return EVENTS + [str(canary)] * canary.exists()


def code_texts(canary):
    """Return texts with code that runs if a reader evaluates, imports, formats or constructs them."""
    python = f"open({str(canary)!r}, 'w')"
    shell = f"touch {canary}"
    module = str(canary.with_name(f"{MODULE}.py"))
    return [
        MODULE, f"{MODULE}:X", f"{MODULE}.part", module, f"{module[:-3]}", f"{MODULE}:guiderail/NarrowPassage",
        "__main__", f"../{MODULE}", python, f"exec({python!r})", f"__import__('os').system({shell!r})",
        f"__import__({MODULE!r})", f"().__class__.__base__.__subclasses__() or {python}", f"(lambda: {python})()",
        "{0.__class__}", "{seed.__init__}", f"!!python/object/apply:os.system [{shell!r}]",
        f"!!python/object/new:exec [{python!r}]", f"!!python/name:{MODULE}.x", f"!!python/module:{MODULE}",
        f"$({shell})", f"`{shell}`", f"; {shell} #", f"| {shell}", f"%({shell})s",
        f"{{{{ cycler.__init__.__globals__.os.popen({shell!r}) }}}}", f"<script>{python}</script>",
        f"file://{module}", f"package://{MODULE}/x.sdf", f"<plugin filename={module!r} name='x'/>",
        f"'''\n{python}\n'''", f"\\n{python}\\n", f"@{module}", f"env:{shell}", "${" + shell + "}", f"cmd:{shell}",
        f'"\n  - !!python/object/apply:exec [{python!r}]\n',
    ]  # fmt: skip


def pickles(canary):
    """Return contents of files with code that runs if a reader unpickles them."""
    content = pickle.dumps(ExecutedOnUnpickling(canary))
    array = io.BytesIO()
    np.save(array, np.array([ExecutedOnUnpickling(canary)], dtype=object), allow_pickle=True)
    archive = io.BytesIO()
    np.savez(
        archive,
        times=np.array([ExecutedOnUnpickling(canary)], dtype=object),
        outputs=np.array([ExecutedOnUnpickling(canary)], dtype=object),
    )
    torch = io.BytesIO()
    with zipfile.ZipFile(torch, "w") as file:
        file.writestr("archive/data.pkl", content)
        file.writestr("archive/version", "3")
    return [
        content,
        array.getvalue(),
        archive.getvalue(),
        torch.getvalue(),
        pickle.dumps({"weights": ExecutedOnUnpickling(canary)}),
    ]


@st.composite
def with_code(draw, content, canary):
    """Draw a file with inserted code: an entry or key of a tree, a part of a text, or a pickled object."""
    code = draw(st.sampled_from(code_texts(canary)))
    place = draw(st.sampled_from(["tree", "tree", "imports", "key", "text", "text", "line", "pickle", "inside"]))
    if place in ("tree", "key", "imports") and (tree := _tree(content)) is not None:
        path = draw(st.sampled_from([path for path in paths_in(tree) if path]))
        parent, last = entry_at(tree, path[:-1]), path[-1]
        if place == "imports" and isinstance(tree, dict):
            tree["imports"] = [code]
        elif place == "key" and isinstance(parent, dict):
            parent[code] = parent.pop(last)
        else:
            parent[last] = draw(st.sampled_from([code, [code], {code: code}, {"imports": [code]}]))
        if content.lstrip().startswith(b"{"):
            return json.dumps(tree).encode()
        return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True).encode()
    start = int(draw(st.floats(0, 1)) * len(content))
    if place in ("pickle", "inside"):
        pickled = draw(st.sampled_from(pickles(canary)))
        return pickled if place == "pickle" else content[:start] + pickled + content[start:]
    if place == "line":
        start = content.rfind(b"\n", 0, start) + 1
    removed = draw(st.sampled_from([0, 0, 1, 8, 40]))
    changed = content[:start] + code.encode() + content[start + removed :]
    return edited(changed, draw(edits(2))) if draw(st.booleans()) else changed


def _tree(content):
    try:
        tree = yaml.safe_load(content)
    except (yaml.YAMLError, UnicodeDecodeError, ValueError):
        return None
    return tree if isinstance(tree, dict | list) and any(paths_in(tree)) else None


# --- Files and their readers ---

STUDY = b"""name: s
task: NarrowPassage
env: {guidance: kgrl}
learner: {preset: tqc_fast, episodes: 2}
methods: {a: {}, b: {policy: zero}}
seeds: [0]
eval_set: [{episodes: 2, file: "{name}-{digest}.csv"}]
folder: "{method}-{seed}"
"""
TASK = {
    "format": FILE_FORMAT, "name": "parts/pin",
    "plug": {"source": "p.stl", "visual": "part.obj", "mass": 0.1, "center": [0, 0, 0], "gyration": 0.01,
             "pieces": [{"file": "part.obj", "modulus": 1e9}]},
    "socket": {"source": "s.stl", "visual": "part.obj", "mass": 0.1, "center": [0, 0, 0], "gyration": 0.01,
               "pieces": [{"file": "part.obj"}]},
    "motion": {"travel": 0.02, "first_contact": 0.01, "push": 0.004}, "demonstrations": {"file": "d.csv"},
    "scenario": ["table.yaml"], "measured": {"clearance": 1},
}  # fmt: skip
SCENARIO = b"""station: simulation
directives:
- add_model: {name: table, file: file:///none.sdf}
lcm_buses: {default: {lcm_url: "memq://"}}
model_drivers: {iiwa14: !IiwaDriver {control_mode: torque_only}}
"""
CSV = b"time,x [m],y [m],z [m]\n0,0,0,0\n0.1,1,2,3\n0.2,2,3,4\n"
BOX = b"v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\nmtllib m.mtl\n"


def write_files(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def npz():
    file = io.BytesIO()
    np.savez(file, times=np.arange(3.0), outputs=np.ones((1, 3, 2)), names=np.array(["x", "y"]))
    return file.getvalue()


def run_files(folder):
    run = RunFolder(folder)
    run.write_config(CONFIGS[0])
    save_checkpoint(run.checkpoint, ARRAYS, VALUES)
    Policy(LAYERS, DESCRIPTION).save(folder)
    write_step_log(run.steps / "episode-000000.parquet", pa.table({"episode": [0, 0], "step": [0, 1]}))
    (folder / "episodes.csv").write_bytes(TABLE)
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read_run(folder):
    run = RunFolder(folder)
    for read in (run.config, run.episodes, lambda: Policy.load(folder), lambda: read_step_log(run.steps)):
        attempt("execution, run folder", InputError, read)
    attempt("execution, checkpoint", InputError, lambda: load_checkpoint(run.checkpoint))


def read_study(folder):
    def read():
        study = load_study(folder / "study.yaml")
        import_stored(study.imports, folder / "study.yaml")
        run_study(study, folder / "study.yaml" / "below a file")

    attempt("execution, study", InputError, read)


def read_task(folder):
    def read():
        file = read_task_file(folder)
        task_folder_digest(folder)
        write_workcell(folder, file)

    attempt("execution, task folder", InputError, read)


def read_demonstrations(folder):
    for path in folder.iterdir():
        attempt("execution, demonstrations", InputError, lambda path=path: Demonstrations.load(path))
    attempt("execution, table", InputError, lambda: import_recording(folder / "d.csv", folder / "new.npz"))
    (folder / "new.npz").unlink(missing_ok=True)


def check_certificate(folder):
    """Check a certificate after its digests have been recomputed, as in a forged certificate."""
    try:
        claims = json.loads((folder / "certificate.json").read_bytes())
        names = ("primitive.npz", "constraints.npz", "witness.npz")
        claims["digests"] = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
        text = json.dumps({key: value for key, value in claims.items() if key != "digest"}, sort_keys=True)
        claims["digest"] = hashlib.sha256(text.encode()).hexdigest()
        (folder / "certificate.json").write_text(json.dumps(claims))
    except (ValueError, TypeError):
        return
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()), suppress(SystemExit):
        patch.setattr(sys, "argv", ["checker.py", str(folder)])
        runpy.run_path(checker.__file__, run_name="__main__")


def read_recordings(folder):
    new = folder / "new.npz"
    for source in ("set", "recording.mcap"):
        attempt(f"execution, {source}", InputError, lambda source=source: import_recording(folder / source, new))
        new.unlink(missing_ok=True)


def recording_files(folder):
    from guiderail_data.formats.lerobot import write_lerobot
    from guiderail_data.formats.ros_bag import write_mcap

    times = 0.1 * np.arange(4)
    demonstrations = Demonstrations([times], [np.column_stack([times] * 6)])
    write_lerobot(folder / "set", demonstrations)
    write_mcap(folder / "bags", demonstrations)
    (mcap,) = (folder / "bags").rglob("*.mcap")
    files = {str(path.relative_to(folder)): path.read_bytes() for path in (folder / "set").rglob("*") if path.is_file()}
    return files | {"recording.mcap": mcap.read_bytes()}


def read_part(folder):
    attempt("execution, mesh", InputError, lambda: load_part(folder / "part.obj", "mm"))
    attempt("execution, scenario", InputError, lambda: load_scenario(folder / "scenario.yaml"))


CLAIMS = {"about": {"task": "x"}, "always": {}, "assumes": ["x"], "budgeted": None, "digest": "", "digests": {}}
CLAIMS |= {"format": "guiderail certificate 4", "free": {}, "impedance": None, "kernel": "squared_exponential"}
CERTIFICATE = {"certificate.json": json.dumps(CLAIMS | {"period": 0.1}).encode()}
TASK_FILES = {
    "task.yaml": yaml.safe_dump(TASK).encode(),
    "part.obj": BOX,
    "d.csv": CSV,
    "table.yaml": b"directives: []\n",
}
MESHES = {"part.obj": BOX, "m.mtl": b"newmtl a\nmap_Kd t.png\n", "scenario.yaml": SCENARIO}
KINDS = {
    "run": (run_files, read_run),
    "study": ({"study.yaml": STUDY}, read_study),
    "task": (TASK_FILES, read_task),
    "demonstrations": ({"d.csv": CSV, "d.npz": npz()}, read_demonstrations),
    "certificate": (
        CERTIFICATE | dict.fromkeys(("primitive.npz", "constraints.npz", "witness.npz"), npz()),
        check_certificate,
    ),
    "recordings": (recording_files, read_recordings),
    "meshes and scenarios": (MESHES, read_part),
}


@pytest.fixture(scope="module", params=KINDS)
def kind(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files") / "folder"
    folder.mkdir()
    files, read = KINDS[request.param]
    files = files(folder) if callable(files) else files
    write_files(folder, files)
    read(folder)  # imports the modules of the reader
    return folder, files, read


def test_unchanged_task_folder_is_valid(tmp_path):
    write_files(tmp_path, TASK_FILES)
    file = read_task_file(tmp_path)
    write_workcell(tmp_path, file)
    assert file.name == TASK["name"]


@few_inputs
@given(st.data())
def test_code_in_a_file_is_not_executed(kind, canary, data):
    folder, files, read = kind
    name = data.draw(st.sampled_from(sorted(files)))
    write_files(folder, {name: data.draw(with_code(files[name], canary))})
    try:
        with audit():
            read(folder)
    finally:
        write_files(folder, {name: files[name]})
    assert executions(canary) == []


@few_inputs
@given(st.data())
def test_code_in_a_template_is_not_executed(canary, data):
    content = data.draw(with_code(data.draw(st.sampled_from(TEMPLATES)).encode(), canary))
    text = content.decode("utf-8", errors="replace")
    with audit():
        attempt("execution, template", InputError, lambda: parse_template(text, "template"))
    assert executions(canary) == []


@few_inputs
@given(st.data())
def test_code_in_an_option_is_not_executed(canary, data):
    code = data.draw(st.sampled_from(code_texts(canary)))
    options = ["guidance", "station", "robot", "kernel", "demonstrations", "difficulty", "reward", "observation"]
    option = data.draw(st.sampled_from([*options, "template"]))
    task = data.draw(st.sampled_from(["NarrowPassage", "BncConnector", "Pouring", "GridClamp", code]))
    with audit():
        attempt("execution, options", InputError, lambda: check_environment(task, {option: as_value(code)}))
    assert executions(canary) == []
