"""Modules named in a file, such as the configuration of a run, are executed only with --trust-imports."""

import sys
from types import ModuleType

import pytest
import yaml

from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail.tools.imports import import_modules, import_stored, trust_imports
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import Run


@pytest.fixture
def canary(tmp_path):
    """Return the path of a module, and the path of the file that the module creates when executed."""
    file = tmp_path / "stored_module.py"
    file.write_text("from pathlib import Path\nPath(__file__).with_name('executed').touch()\n")
    return file, tmp_path / "executed"


def write_imports(run, *modules):
    file = run / "config.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | {"imports": list(map(str, modules))}))


def test_run_configuration_executes_nothing_without_trust(bead_run, canary):
    file, executed = canary
    write_imports(bead_run, file)
    with pytest.raises(InputError, match=r"stored_module.py.*--trust-imports"):
        RunFolder(bead_run).config()
    assert not executed.exists()
    with trust_imports():
        assert RunFolder(bead_run).config().imports == (str(file),)
    assert executed.exists()
    executed.unlink()
    file.write_text(file.read_text() + "# changed after it was trusted\n")
    RunFolder(bead_run).config()  # trusted, because this process has imported the file


def test_file_that_the_user_names_needs_no_trust(bead_run, canary):
    file, executed = canary
    write_imports(bead_run, file)
    import_modules([str(file)])
    executed.unlink()
    RunFolder(bead_run).config()
    assert not executed.exists(), "the module was executed twice"


@pytest.mark.parametrize("name", ["stored_module", "stored_module.part", "json.tool"])
def test_module_that_is_not_loaded_needs_trust(name, canary, monkeypatch):
    file, executed = canary
    monkeypatch.syspath_prepend(file.parent)
    with pytest.raises(InputError, match="--trust-imports"):
        import_stored([name], file)
    assert not executed.exists()
    assert name not in sys.modules


@pytest.mark.parametrize("name", ["stored_module/part", "../stored_module", "/etc/stored_module", "", ".x", "a..b"])
def test_path_is_refused_as_the_name_of_a_module(name, canary, monkeypatch):
    file, executed = canary
    monkeypatch.syspath_prepend(file.parent)
    with trust_imports(), pytest.raises(InputError, match="there is no"):
        import_stored([name], file)
    assert not executed.exists()


def test_folder_without_code_is_refused_as_a_module(tmp_path, monkeypatch):
    (tmp_path / "lab_recordings").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="there is no module, file or task folder lab_recordings"):
        import_modules(["lab_recordings"])


def test_loaded_module_needs_no_trust(tmp_path):
    assert import_stored(["json"], tmp_path / "config.yaml") == ("json",)


def test_printed_evaluate_command_is_trusted_and_quoted(bead_run, canary):
    run = bead_run.rename(bead_run.with_name("run one"))

    def printed_arguments():
        return Run(run).summary["success_in_training"].partition("guiderail evaluate ")[2]

    assert printed_arguments() == f"'{run}'"
    write_imports(run, canary[0])
    assert printed_arguments() == f"'{run}' --trust-imports"
    assert not canary[1].exists()
    (run / "task.yaml").touch()
    write_imports(run, run)  # a task folder contains no code
    assert printed_arguments() == f"'{run}'"


COMMANDS = (
    ("evaluate", "RUN"), ("robustness", "RUN"), ("certify", "RUN"), ("visualize", "RUN"),
    ("report", "RUN", "--episodes", "1"), ("train", "--resume", "--out", "RUN"), ("deploy", "RUN", "--sim", "--yes"),
    ("deploy", "RUN", "--sim", "--yes", "--episodes", "1"), ("study", "STUDY", "--out", "OUT"),
)  # fmt: skip


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_command_executes_nothing_from_a_folder_without_trust(arguments, bead_run, canary, capsys, tmp_path):
    file, executed = canary
    write_imports(bead_run, file)
    study = tmp_path / "study.yaml"
    study.write_text(f"name: s\ntask: Bead\nmethods: {{a: {{}}}}\nseeds: [0]\nimports: ['{file}']\n")
    paths = {"RUN": str(bead_run), "STUDY": str(study), "OUT": str(tmp_path / "out")}
    with pytest.raises(SystemExit) as end:
        main([paths.get(argument, argument) for argument in arguments])
    message = capsys.readouterr().err
    assert end.value.code == 2
    assert str(file) in message
    assert "--trust-imports" in message
    assert not executed.exists()


def test_trust_ends_with_the_command(bead_run, canary, capsys, tmp_path):
    file, executed = canary
    write_imports(bead_run, file)
    with pytest.raises(SystemExit) as end:
        main(["report", str(bead_run), "--out", str(tmp_path / "report.html"), "--trust-imports"])
    assert end.value.code == 0
    assert executed.exists()
    with pytest.raises(InputError, match="--trust-imports"):
        import_stored(["another_module"], file)


@pytest.mark.parametrize(
    "line", ["raise RuntimeError(3)", "raise ImportError(3)", "1 +", "raise SystemExit(3)", "int('a')"]
)
def test_failure_of_the_package_of_a_module_is_reported(line, tmp_path, monkeypatch):
    (tmp_path / "failing_package").mkdir()
    (tmp_path / "failing_package" / "__init__.py").write_text(line)
    (tmp_path / "failing_package" / "part.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "without_specification", ModuleType("without_specification"))
    with pytest.raises(InputError, match=r"importing failing_package.part failed: .*(Error|SystemExit)"):
        import_modules(["failing_package.part"])
    with pytest.raises(InputError, match="there is no module"):
        import_modules(["without_specification"])


def test_file_that_ends_the_program_is_an_error(tmp_path):
    (tmp_path / "ends.py").write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(InputError, match=r"importing ends.py failed: ends.py, line 2: SystemExit: 0"):
        import_modules([str(tmp_path / "ends.py")])
