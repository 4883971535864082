"""What the documents say of the code is so."""

import ast
import importlib
import itertools
import json
import re
import shlex
import textwrap
from contextlib import suppress
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
import yaml
from matplotlib import pyplot

import rangeseg_ros
from rangeseg_ros import RangeImage
from rangeseg_ros.cli.main import rangeseg
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.tables import columns
from rangeseg_ros.messages.outputs import MAP_OUTPUTS, OUTPUTS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'rangeseg_ros'
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md'))]
# Pages that docs/hooks.py makes.
GENERATED = ('parameters.md',)
# Where the documents count paths from.
FOLDERS = [ROOT, PACKAGE, PACKAGE / 'core', ROOT / 'docs', ROOT / 'test']


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_files_commands_and_their_options_exist(page):
    text = page.read_text()
    for link in re.findall(r'\]\(([^)#:]+)(?:#[^)]*)?\)', text):
        assert (page.parent / link).exists() or link in GENERATED, link
    for name in re.findall(r'`((?:[\w.]+/)*\w+\.(?:py|md|toml|cff|rst))`', text):
        nested = [folder / name for folder in FOLDERS]
        assert any(path.exists() for path in nested) or any(PACKAGE.rglob(name)), name
    text = text.replace('\\\n', ' ')
    told = re.findall(r'^(?:    |RUN .*&& )rangeseg ([^\n]+)|`rangeseg ([^`]+)`', text, re.M)
    for words in told:
        command, context = rangeseg, click.Context(rangeseg)
        words = shlex.split(''.join(words), comments=True)
        while isinstance(command, click.Group) and words and words[0][0] not in '-<':
            name = words.pop(0)
            command = command.get_command(context, name)
            assert command, name
            context = click.Context(command, parent=context)
        with suppress(click.BadOptionUsage):  # named alone, without what it takes
            command.make_parser(context).parse_args(words)


@pytest.mark.parametrize('page', ['README.md', 'docs/python.md', 'docs/your-data.md'])
def test_python_that_is_shown_runs(page, seen):
    points = RangeImage.from_depth(seen.depth, seen.camera).points
    known = {'depth': seen.depth, 'points': points, 'frames': [(0, seen.depth, np.eye(4))]}
    text = (ROOT / page).read_text()
    for code in re.findall(r'```python\n(.*?)```', text, re.S):
        exec(code, known)
    assert known['result'].planes and known['result'].verdict.ok
    # What needs a device; the pages say that it is untried.
    for code in re.findall(r'untried:\n\n```py\n(.*?)```', text, re.S):
        compile(code, page, 'exec')
    assert text.count('```py\n') == text.count('untried:\n\n```py\n')


def shown_commands(page):
    """Commands of a page, without comments."""
    lines = re.findall(r'^    rangeseg ([^\n]+)', (ROOT / page).read_text(), re.M)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.slow
def test_the_tutorial_can_be_followed(tmp_path, monkeypatch, run):
    pyplot.switch_backend('agg')
    monkeypatch.chdir(tmp_path)
    text = (ROOT / 'docs/tutorial.md').read_text()
    lines = re.findall(r'^    (.*(?:segment_planes:|up_.*))$', text, re.M)
    Path('up.yaml').write_text('\n'.join(lines))
    for words in shown_commands('docs/tutorial.md'):
        assert run(*words)[0] == 0, words
    (code,) = re.findall(r'```python\n(.*?)```', text, re.S)
    known = {}
    exec(code, known)
    pyplot.close('all')
    assert known['result'].verdict.ok and known['table'].role.isin(['floor']).any()
    for name in re.findall(r'`((?:planes|recording)/[\w.]+)`', text):
        assert Path(name).is_file(), name


@pytest.mark.slow
def test_recipes_for_data_run(tmp_path, monkeypatch, run, seen):
    """Each command of docs/your-data.md, on files of the kind it is for."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / 'docs/your-data.md').read_text()
    shown = re.search(r'by hand:\n\n((?:    .*\n)+)', text)[1]
    Path('camera.yaml').write_text(textwrap.dedent(shown))
    matrix = [525, 0, 0, 0, 525, 0, 319.5, 239.5, 1]
    intrinsics = {'width': 640, 'height': 480, 'intrinsic_matrix': matrix}
    Path('intrinsics.json').write_text(json.dumps(intrinsics))
    tum, scenes = Path('rgbd_dataset_freiburg1_desk'), Path('seq-01')
    write_image(Path('frame.png'), seen.depth)
    write_image(scenes / 'frame-000000.depth.png', seen.depth)
    write_image(tum / 'depth/1305031453.374112.png', 5 * seen.depth)
    write_image(tum / 'rgb/1305031453.374112.png', np.zeros((480, 640, 3), np.uint8))
    (tum / 'depth.txt').write_text('# depth\n1305031453.374112 depth/1305031453.374112.png\n')
    assert run('pack', scenes, '--camera', 'camera.yaml', '--output', 'recording.bag')[0] == 0
    for number, words in enumerate(shown_commands('docs/your-data.md')):
        if '0.0002' in words:
            words[1] = str(tum / 'depth/1305031453.374112.png')
        assert run(*words, '--output', number)[0] == 0, words  # the last output counts
        (labels,) = Path(str(number)).rglob('*_labels.png')
        assert cv2.imread(str(labels), cv2.IMREAD_UNCHANGED).max() > 5


def test_the_python_interface_columns_of_planes_and_topics_are_explained():
    rows = re.findall(r'^\| `(\w+)` \| (.*) \|$', (ROOT / 'docs/api.md').read_text(), re.M)
    assert {name for name, _ in rows} == {*rangeseg_ros.__all__} - {'__version__'}
    for name, text in rows[:-1]:
        assert text == getattr(rangeseg_ros, name).__doc__.splitlines()[0]
    text = (ROOT / 'docs/offline.md').read_text()
    table = text[text.index('## planes.csv') : text.index('## Recordings')]
    # Of many alike, as covariance_xx to covariance_dd, the first and the last are named.
    families = ('covariance_', 'centre_', 'orientation_')
    for column in columns():
        assert f'`{column}`' in table or column.startswith(families), column
    text = (ROOT / 'docs/ros.md').read_text()
    for topic in (*OUTPUTS, *MAP_OUTPUTS):
        assert f'`~/{topic}`' in text, topic
    # The settings of Nav2 are YAML and name topics.
    for text in re.findall(r'```yaml\n(.*?)```', (ROOT / 'docs/navigation.md').read_text(), re.S):
        topics = re.findall(r'/segment_planes/(\w+)', text)
        assert yaml.safe_load(text) and topics and set(topics) <= set(OUTPUTS)


def test_the_notebook_runs():
    cells = json.loads((ROOT / 'examples/first_steps.ipynb').read_text())['cells']
    known = {}
    for cell in cells:
        if cell['cell_type'] == 'code':
            exec(''.join(cell['source']), known)
    assert len(known['table']) == len(known['result'].planes) > 5
    assert known['wrong'].verdict.reasons == ('scale improbable',)


def test_every_room_is_on_the_page_of_the_architecture():
    text = (ROOT / 'docs/architecture.md').read_text()
    for folder in (PACKAGE, PACKAGE / 'core'):
        for path in folder.iterdir():
            if path.is_dir() and (path / '__init__.py').exists() and path.name != 'core':
                assert f'`{path.name}/`' in text, path.name
            elif path.suffix == '.py' and path.name != '__init__.py':
                assert f'`{path.name}`' in text, path.name
    # Functions are where it says.
    pairs = re.findall(r'`(\w+)`(?:\(\))? (?:\(|in |of )`([\w/]+\.py)`', text)
    assert len(pairs) > 5
    for name, file in pairs:
        paths = [folder / file for folder in FOLDERS if (folder / file).exists()]
        paths = paths or list(PACKAGE.rglob(file))
        pattern = rf'^(def|class|   ) {name}\b|^{name}\b.* = '
        assert re.search(pattern, paths[0].read_text(), re.M), (name, file)


def test_the_table_of_constants_is_that_of_the_code():
    """Those that decide results are in the table, the others have a comment."""
    text = (ROOT / 'docs/method.md').read_text()
    # A row may have several of one module: names with commas, values with semicolons.
    rows = re.findall(r'^\| `([\w/]+)` \| (`.+?`) \| (.*?) \| [ad] \| .+? \|.*\|$', text, re.M)
    assert len(rows) == text[text.index('<!-- const') : text.index('<!-- /const')].count('\n') - 3
    shown = {
        (module, name): value
        for module, names, values in rows
        for name, value in zip(re.findall(r'\w+', names), values.split('; '), strict=True)
    }
    assert shown.items() <= {key: value for key, value, _ in constants()}.items()
    assert {key for key, _, commented in constants() if not commented} <= shown.keys()


def constants():
    """Numbers in capitals of modules of the core, and the comment beside, above or below each."""
    core = PACKAGE / 'core'
    for path in core.rglob('*.py'):
        name = path.relative_to(core).with_suffix('').as_posix()
        module = importlib.import_module(f'rangeseg_ros.core.{name.replace("/", ".")}')
        lines, statements = path.read_text().splitlines(), ast.parse(path.read_text()).body
        for statement, after in itertools.pairwise([*statements, None]):
            if not isinstance(statement, ast.Assign):
                continue
            above = itertools.takewhile(str.strip, reversed(lines[: statement.lineno - 1]))
            commented = (
                any(line.startswith('#') for line in above)
                or '#' in lines[statement.lineno - 1]
                or isinstance(getattr(after, 'value', None), ast.Constant)
            )
            (target,), value = statement.targets, statement.value
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = zip(target.elts, value.elts, strict=True) if several else [(target, value)]
            for target, value in pairs:
                known = getattr(target, 'id', '')
                if known.isupper() and numeric(getattr(module, known)):
                    yield (name, known), ast.unparse(value), commented


def numeric(value):
    if type(value) is tuple:
        return len(value) > 0 and all(map(numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)
