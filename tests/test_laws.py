"""Tests of the laws in CONTRIBUTING.md: they read the source tree."""

import ast
import graphlib
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("spec", "model", "generators", "conformance")  # imports point left only
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))

# Law 1: numbers of 0x100 and more that are no facts of the protocol.
# (file, literal as written) -> why it may stand in Python.
ALLOWED_NUMBERS: dict[tuple[str, str], str] = {
    ("generators/formats/pcapng_format.py", "0x1001"): "the MainDevice gives station addresses",
}

# Law 3: what the core may not import, since it is a clock, a network, a process or a true random.
OUTSIDE_WORLD = {"asyncio", "secrets", "select", "signal", "socket", "subprocess", "time"}

# Lines of a module at most, by folder, and of a function; and what is above that.
MOST_LINES = {"spec": 500, "model": 500, "generators": 600, "conformance": 600}
LONG_MODULES: dict[str, int] = {}
MOST_LINES_OF_FUNCTION = 60
LONG_FUNCTIONS: dict[str, int] = {
    "ecatspec.conformance.cli.run.run": 63,
    "ecatspec.conformance.diff.report.as_data": 65,
    "ecatspec.conformance.run.runner.run_device": 72,
    "ecatspec.conformance.run.state_machine._machine": 125,
    "ecatspec.generators.complete.suites._suite": 66,
    "ecatspec.generators.covers.transfer_cover._interruptions": 165,
    "ecatspec.generators.covers.transfer_cover._uploads": 66,
    "ecatspec.model.core.compilation.__init__": 92,
    "ecatspec.model.core.object_dictionary.__init__": 74,
    "ecatspec.model.symbolic.smt_encoding._value": 62,
}

# Public members of a class at most, and the classes that are above that.
MOST_MEMBERS = 25
MEMBERS_OF_ORACLE = 20
GRAMMAR = "one method for each rule of the grammar"
LARGE_CLASSES: dict[str, str] = {
    "ecatspec.generators.complete.chain._Chain": "the search keeps its work beside what it found",
    "ecatspec.model.core.compilation.Model": "all that is worked out of a text before it runs",
    "ecatspec.model.esc.wire.WireFormat": "one member for each part of a frame",
    "ecatspec.spec.language.build_expressions.ExpressionBuilder": GRAMMAR,
    "ecatspec.spec.language.build_machines.MachineBuilder": GRAMMAR,
    "ecatspec.spec.language.build_text.TextBuilder": GRAMMAR,
    "ecatspec.spec.language.ir.protocol.Protocol": "one member for each kind of declaration",
}


def name_of(path: Path) -> str:
    """File in the tree -> module of the installed package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("ecatspec", *(parts[:-1] if parts[-1] == "__init__" else parts)))


MODULES = {name_of(path): path for path in SOURCES}
each_module = pytest.mark.parametrize("module", sorted(MODULES))


def imports_of(module: str) -> Iterator[tuple[int, str]]:
    """Line and full name of everything a module imports, wherever in the module it does so."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_bytes())):
        match node:
            case ast.Import(names=names):
                yield from ((node.lineno, alias.name) for alias in names)
            case ast.ImportFrom(module=source, names=names, level=level):
                base = source or ""
                if level:
                    above = package.split(".")[: len(package.split(".")) - level + 1]
                    base = ".".join((*above, *([source] if source else [])))
                yield from ((node.lineno, f"{base}.{alias.name}") for alias in names)
            case _:
                pass


def home_of(imported: str) -> str | None:
    """The module of the tree that an imported name comes from."""
    if imported in MODULES:
        return imported
    parent = imported.rpartition(".")[0]
    return parent if parent in MODULES else None


def texts_below(folder: Traversable, prefix: str = "") -> Iterator[str]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from texts_below(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith((".ecs", ".lark")):
            yield prefix + entry.name


def test_every_folder_has_modules() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in SOURCES} == set(FOLDERS)


@each_module
def test_law_1_no_protocol_number_in_python(module: str) -> None:
    path = MODULES[module]
    file = path.relative_to(ROOT).as_posix()
    with path.open("rb") as stream:
        found = [
            f"{file}:{token.start[0]}: {token.string}"
            for token in tokenize.tokenize(stream.readline)
            if token.type == tokenize.NUMBER
            and token.string.lower().startswith("0x")
            and int(token.string, 16) >= 0x100
            and (file, token.string) not in ALLOWED_NUMBERS
        ]
    assert not found, "a fact of the protocol stands in a text of spec/; ask the specification"


def test_law_1_every_allowed_number_is_needed() -> None:
    for (file, literal), reason in ALLOWED_NUMBERS.items():
        assert literal in (ROOT / file).read_text("utf-8"), (file, literal)
        assert reason, (file, literal)


@each_module
def test_law_2_imports_point_left(module: str) -> None:
    here = FOLDERS.index(module.split(".")[1])
    found = []
    for line, imported in imports_of(module):
        top, _, rest = imported.partition(".")
        if top == "ecatspec":
            folder = rest.partition(".")[0]
            if folder not in FOLDERS[: here + 1]:
                found.append(f"{MODULES[module]}:{line}: {imported}")
        elif top in FOLDERS:  # works in a checkout only, and makes a second copy of every class
            found.append(f"{MODULES[module]}:{line}: {imported} without ecatspec")
    assert not found, f"{module} may import from {FOLDERS[: here + 1]}"


def test_law_2_no_cycles() -> None:
    graph = {
        module: {home for _, name in imports_of(module) if (home := home_of(name))} - {module}
        for module in MODULES
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail("a cycle: " + " -> ".join(reversed(error.args[1])))


def rooms() -> list[str]:
    """The folders in the order of the map in docs/architecture.md."""
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    part = text.partition("## Map of the folders")[2].partition("\n## ")[0]
    return re.findall(r"^\| `([\w/.]+)` \|", part, re.MULTILINE)


def room_of(module: str) -> str:
    """The folder of a module, or the module where it is in none."""
    path = MODULES[module].relative_to(ROOT)
    return "/".join(path.parts[:2])


def test_law_2_imports_of_folders_point_up_in_the_map() -> None:
    order = rooms()
    assert len(set(order)) == len(order)
    inside = {module for module in MODULES if not is_top(module)}
    assert {room_of(module) for module in inside} == set(order)
    found = [
        f"{MODULES[module].relative_to(ROOT)}:{line}: {imported}"
        for module in inside
        for line, imported in imports_of(module)
        if (home := home_of(imported)) in inside
        and order.index(room_of(home)) > order.index(room_of(module))
    ]
    assert not found, "imports from a folder below in the map of docs/architecture.md"


def is_top(module: str) -> bool:
    """Whether a module is the door of one of the four packages."""
    return module.count(".") == 1


def test_the_map_has_the_first_sentence_of_each_folder() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    for room in rooms():
        path = ROOT / room
        source = path / "__init__.py" if path.is_dir() else path
        words = ast.get_docstring(ast.parse(source.read_bytes()))
        assert words is not None
        assert f"| `{room}` | {words.splitlines()[0].rstrip('.')} |" in text


def test_the_ways_in_name_what_is_there() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    part = text.partition("## Three ways in")[2].partition("\n## ")[0]
    paths = re.findall(r"`([\w/]+(?:/|\.\w+))`", part)
    assert len(paths) >= 6
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_words_of_the_glossary_are_used() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text("utf-8")
    words = re.findall(r"^\| ([a-zA-Z ]+) \| (?!meaning)", text, re.MULTILINE)
    assert len(words) > 30
    used = "\n".join(path.read_text("utf-8").lower() for path in SOURCES)
    for page in sorted((ROOT / "docs").glob("*.md")):
        used += page.read_text("utf-8").lower() if page.name != "glossary.md" else ""
    assert [word for word in words if word.lower() not in used] == []


def functions_of(module: str) -> Iterator[tuple[str, int]]:
    """Name and lines of each function, without its decorators."""
    for node in ast.walk(ast.parse(MODULES[module].read_bytes())):
        if isinstance(node, ast.FunctionDef):
            yield f"{module}.{node.name}", (node.end_lineno or node.lineno) - node.lineno + 1


def test_modules_are_short() -> None:
    lines = {module: path.read_text("utf-8").count("\n") for module, path in MODULES.items()}
    long = {m: n for m, n in lines.items() if n > MOST_LINES[m.split(".")[1]]}
    assert long.keys() == LONG_MODULES.keys()
    assert [m for m, n in long.items() if n > LONG_MODULES[m]] == [], "divide it; it must not grow"


def test_functions_are_short() -> None:
    every = [found for module in MODULES for found in functions_of(module)]
    long = {name: n for name, n in every if n > MOST_LINES_OF_FUNCTION}
    assert long.keys() == LONG_FUNCTIONS.keys()
    assert [m for m, n in long.items() if n > LONG_FUNCTIONS[m]] == [], (
        "divide it; it must not grow"
    )


def test_law_2_spec_imports_lark_and_nothing_else() -> None:
    allowed = {*sys.stdlib_module_names, "ecatspec", "lark"}
    found = [
        f"{MODULES[module]}:{line}: {imported}"
        for module in MODULES
        if module.split(".")[1] == "spec"
        for line, imported in imports_of(module)
        if imported.partition(".")[0] not in allowed
    ]
    assert not found


def test_law_3_the_core_knows_no_outside_world() -> None:
    found = [
        f"{MODULES[module]}:{line}: {imported}"
        for module in MODULES
        if module.split(".")[1] != "conformance"
        for line, imported in imports_of(module)
        if imported.partition(".")[0] in OUTSIDE_WORLD
    ]
    assert not found, "time is an input; I/O lives in adapters and the command line"


# Law 3: where the core may touch files: it reads its own texts, and what a user names.
FILES_OF_THE_CORE = {
    "ecatspec.generators.formats.c_format",  # the runner in C that it puts before the tables
    "ecatspec.spec.language.grammar",
    "ecatspec.spec.language.load",
}
FILE_CALLS = {"open", "read_bytes", "read_text", "write_bytes", "write_text", "mkstemp", "unlink"}
FILE_CALLS |= {"mkdir", "rename", "rmdir", "TemporaryFile", "NamedTemporaryFile"}


def file_calls_of(module: str) -> Iterator[str]:
    """Calls by which a module reaches files, as `name:line`."""
    for node in ast.walk(ast.parse(MODULES[module].read_bytes())):
        if isinstance(node, ast.Call):
            called = node.func
            name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
            if name in FILE_CALLS:
                yield f"{name}:{node.lineno}"


def test_law_3_the_core_touches_no_files() -> None:
    core = {module for module in MODULES if module.split(".")[1] in {"spec", "model", "generators"}}
    touching = {module: list(file_calls_of(module)) for module in sorted(core)}
    assert {module for module, calls in touching.items() if calls} == FILES_OF_THE_CORE
    writes = {"write_bytes", "write_text", "mkstemp", "unlink", "mkdir", "rename", "rmdir"}
    every = [call.partition(":")[0] for calls in touching.values() for call in calls]
    assert not writes & set(every)


@each_module
def test_law_12_the_first_line_says_what_the_module_is_for(module: str) -> None:
    docstring = ast.get_docstring(ast.parse(MODULES[module].read_bytes()))
    assert docstring, f"{MODULES[module]}:1: a module starts with a docstring"
    assert docstring.splitlines()[0].strip()


def classes_of(module: str) -> Iterator[tuple[str, set[str]]]:
    """Name and public members of every class of a module; the rows of an enum are no members."""
    for node in ast.walk(ast.parse(MODULES[module].read_bytes())):
        if isinstance(node, ast.ClassDef):
            names = {name for part in node.body for name in members_in(part)}
            yield f"{module}.{node.name}", {name for name in names if not name.startswith("_")}


def members_in(part: ast.stmt) -> Iterator[str]:
    """What a statement of a class defines: a field, a method, what a method keeps in `self`."""
    match part:
        case ast.AnnAssign(target=ast.Name(id=name)):
            yield name
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
            yield name
            for node in ast.walk(part):
                match node:
                    case ast.Attribute(value=ast.Name(id="self"), attr=kept, ctx=ast.Store()):
                        yield kept
                    case _:
                        pass
        case _:
            pass


def test_no_class_has_too_many_public_members() -> None:
    large = {
        name
        for module in MODULES
        for name, members in classes_of(module)
        if len(members) > MOST_MEMBERS
    }
    assert large == LARGE_CLASSES.keys()


def test_the_oracle_has_few_public_members() -> None:
    members = dict(classes_of("ecatspec.model.oracle.oracle"))
    assert len(members["ecatspec.model.oracle.oracle.Oracle"]) <= MEMBERS_OF_ORACLE


def test_package_list_equals_the_tree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    tree = {name_of(path) for path in SOURCES if path.name == "__init__.py"}
    assert set(project["tool"]["setuptools"]["packages"]) == tree


def test_every_module_is_in_a_package() -> None:
    outside = [path for path in SOURCES if not (path.parent / "__init__.py").exists()]
    assert not outside, "the wheel would lack these"


def test_every_text_is_installed() -> None:
    tree = {
        path.relative_to(ROOT / "spec").as_posix()
        for path in (ROOT / "spec").rglob("*")
        if path.suffix in {".ecs", ".lark"}
    }
    assert set(texts_below(resources.files("ecatspec.spec"))) == tree


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_folder_is_typed_for_the_checker(folder: str) -> None:
    assert (ROOT / folder / "py.typed").is_file()
    if (ROOT / "PKG-INFO").exists():
        pytest.skip("a source distribution carries no links")
    assert (ROOT / "typings" / "ecatspec" / folder).resolve() == ROOT / folder


def test_the_checker_reads_the_tree_and_not_the_wheel() -> None:
    # Without this file mypy takes a namespace apart and prefers the typed copy that is installed:
    # it then checks the state of the last installation.
    if (ROOT / "PKG-INFO").exists():
        pytest.skip("a source distribution carries no links")
    assert (ROOT / "typings" / "ecatspec" / "__init__.pyi").is_file()
