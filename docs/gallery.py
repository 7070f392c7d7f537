# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Runs the programs and notebooks of ``examples/``, and makes a page of each.

.venv/bin/python docs/gallery.py FOLDER [--duration S]: programs whose page is in FOLDER already,
made by the same code, are not run again.
"""

import argparse
import ast
import base64
import hashlib
import importlib.util
import inspect
import json
from pathlib import Path
import shutil
import subprocess
import sys
import time

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / 'examples'
BAG = ROOT / 'test' / 'golden' / 'stops.mcap'
"""What the examples read that begin with a bag."""
OUTPUTS = Path('runs') / 'examples'
"""Where the examples write, in the folder in which they run."""
LICENCE = 13
"""Lines of the header of a program."""
NOTEBOOK_TIMEOUT = 600  # s, for a cell
PICTURES = ('.png', '.svg', '.gif')


def make_gallery(folder, duration=None):
    """Make a page of each example, and their index.

    With a duration each run takes so many seconds: that shows that all works, and is no result.
    """
    folder.mkdir(parents=True, exist_ok=True)
    titles = {}
    for source in sorted([*EXAMPLES.glob('*.py'), *EXAMPLES.glob('*.ipynb')]):
        # A program and a notebook may have the same name.
        name = source.stem if source.suffix == '.py' else f'{source.stem}_notebook'
        place, page, key = folder / name, folder / f'{name}.md', _key(source, duration)
        stamp = place / 'key'
        if not (page.exists() and stamp.exists() and stamp.read_text() == key):
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            print(source.relative_to(ROOT), file=sys.stderr, flush=True)
            make = _program_page if source.suffix == '.py' else _notebook_page
            page.write_text(make(source, place, duration), encoding='utf-8')
            stamp.write_text(key)
        titles[name] = page.read_text(encoding='utf-8').partition('\n')[0].removeprefix('# ')
    _forget_others(folder, titles)
    (folder / 'index.md').write_text(_index(folder, titles), encoding='utf-8')


def _key(source, duration):
    """Return a digest of what makes a page: the example, the package, this file."""
    digest = hashlib.sha256(repr(duration).encode())
    for path in [source, Path(__file__), BAG, *sorted((ROOT / 't3mpc_ros').rglob('*.py'))]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _forget_others(folder, names):
    """Remove what was made of examples that are gone."""
    for path in folder.iterdir():
        if path.stem not in {*names, 'index'}:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _program_page(source, place, duration):
    text = source.read_text(encoding='utf-8')
    title = ast.get_docstring(ast.parse(text)).partition('\n')[0].rstrip('.')
    began = time.monotonic()
    output = _run_program(source, place, duration)
    taken = time.monotonic() - began
    made = sorted(path.relative_to(place) for path in (place / OUTPUTS).glob('*.*'))
    pictures = [path for path in made if path.suffix in PICTURES]
    others = [path for path in made if path.suffix in ('.html', '.csv')]
    lines = [
        f'# {title}',
        '',
        f'`examples/{source.name}`, made by running it in {taken:.0f} s.',
        '',
    ]
    for path in pictures:
        lines += [f'![{title}: {path.stem}]({place.name}/{path})', '']
    if output:
        lines += ['## Output', '', *_printed(output), '']
    if others:
        links = ', '.join(f'[{path.name}]({place.name}/{path})' for path in others)
        lines += [f'Files: {links}.', '']
    code = '\n'.join(text.splitlines()[LICENCE:])
    return '\n'.join([*lines, '## Program', '', '```python', code.strip(), '```', ''])


def _printed(text):
    """Return the lines of a page for what a program or a cell printed; tables are Markdown."""
    if '|---' not in text:
        return ['```text', text.rstrip(), '```']
    lines = ['<div class="result" markdown="1">', '']
    for line in text.splitlines():
        lines += [line] if line.startswith('|') else [line, '']
    return [*lines, '', '</div>']


def _run_program(source, place, duration):
    """Return what a program prints; its files are in the folder ``place``."""
    if duration is None:
        words = [source, *([BAG] if 'sys.argv' in source.read_text() else ())]
    else:
        words = [Path(__file__), '--program', source, '--duration', str(duration)]
    done = subprocess.run(
        [sys.executable, *words], cwd=place, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f'{source.name} failed:\n{done.stdout}{done.stderr}')
    return done.stdout


def run_shortly(source, duration):
    """Run a program in this process, each of its runs for some seconds."""
    spec = importlib.util.spec_from_file_location(source.stem, source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    short = {'duration': duration, 'path': BAG, 'executor': 1, 'generations': 1, 'side': 1.0}
    known = inspect.signature(module.main).parameters
    module.main(**{name: value for name, value in short.items() if name in known})


# -- notebooks ------------------------------------------------------------------------------------


def execute(source, place, duration=None):
    """Return a notebook with the outputs of its cells, which run in the folder ``place``.

    With a duration, each number of seconds that the notebook names so is that one.
    """
    from nbclient import NotebookClient
    import nbformat

    notebook = nbformat.read(source, 4)
    if duration is not None:
        for cell in notebook.cells:
            lines = cell.source.splitlines()
            short = [f'duration = {duration}' if x.startswith('duration = ') else x for x in lines]
            cell.source = '\n'.join(short)
    client = NotebookClient(
        notebook,
        timeout=NOTEBOOK_TIMEOUT,
        coalesce_streams=True,
        kernel_name='python3',
        resources={'metadata': {'path': str(place)}},
    )
    client.execute()
    return notebook


def _notebook_page(source, place, duration):
    notebook = execute(source, place, duration)
    (place / source.name).write_text(json.dumps(notebook, indent=1) + '\n', encoding='utf-8')
    first, *others = notebook.cells
    title, _, text = first.source.partition('\n')
    file = f'{place.name}/{source.name}'
    lines = [title, '', f'[`examples/{source.name}`]({file}), with the outputs of this run.', text]
    for number, cell in enumerate(others):
        if cell.cell_type == 'markdown':
            lines += ['', cell.source]
            continue
        lines += ['', '```python', cell.source, '```']
        for index, output in enumerate(cell.outputs):
            lines += ['', *_output(output, place, f'{number}_{index}')]
    return '\n'.join(lines) + '\n'


def _output(output, place, name):
    """Return the lines of a page for an output of a cell: a picture, a table or text."""
    data = output.get('data', {'text/plain': output.get('text', '')})
    if 'image/png' in data:
        (place / f'{name}.png').write_bytes(base64.b64decode(data['image/png']))
        return [f'![Output of the cell above]({place.name}/{name}.png)']
    if 'text/html' in data:
        return ['<div class="result" markdown="0">', data['text/html'], '</div>']
    text = data.get('text/plain', '').rstrip()
    return _printed(text) if text else []


def _index(folder, titles):
    """Return the page with all examples: title, and its first picture."""
    lines = [
        '# Examples',
        '',
        'Each page is a program or a notebook of `examples/`, with what it printed and drew when '
        'this site was made.',
        '',
    ]
    for name, title in titles.items():
        lines.append(f'## [{title}]({name}.md)')
        text = (folder / f'{name}.md').read_text(encoding='utf-8')
        picture = next((line for line in text.splitlines() if line.startswith('![')), None)
        lines += ['', *([f'[{picture}]({name}.md)', ''] if picture else ())]
    return '\n'.join(lines)


def main():
    """Make the gallery, or run one program of it."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('folder', type=Path, nargs='?', help='of the pages')
    parser.add_argument('--duration', type=float, metavar='S', help='of each run: no results')
    parser.add_argument('--program', type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.program:
        run_shortly(options.program, options.duration)
    elif options.folder:
        make_gallery(options.folder.resolve(), options.duration)
    else:
        parser.error('a folder is needed')


if __name__ == '__main__':
    main()
