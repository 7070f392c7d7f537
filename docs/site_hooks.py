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
"""Hooks of mkdocs: pages of the repository outside ``docs/``, the gallery, and links to both."""

import os
from pathlib import Path, PurePosixPath
import re

from mkdocs.structure.files import File

from t3mpc_ros.version import VERSION

ROOT = Path(__file__).resolve().parents[1]
GALLERY = Path(os.environ['T3MPC_GALLERY'])
"""Folder that ``docs/gallery.py`` has filled."""
LIBRARIES = {path.name: path for path in Path(os.environ['T3MPC_LIBRARIES']).glob('*.js')}
"""Scripts that could be fetched: without them diagrams are text, and the search needs a server."""
MERMAID, SHIM = 'mermaid.min.js', 'iframe-worker.js'
PAGES = {
    'README.md': 'overview.md',
    'CONTRIBUTING.md': 'contributing.md',
    'SECURITY.md': 'security.md',
    'CHANGELOG.rst': 'changes.md',
}
"""Pages of the site that are files of the repository outside ``docs/``."""
LINK = re.compile(r'(\]\()([^()\s]+)(\))')


def on_config(config):
    """Add the pages of the gallery to the navigation; name the version; draw diagrams or not."""
    pages = sorted(f'gallery/{path.name}' for path in GALLERY.glob('*.md'))
    first = 'gallery/index.md'
    sections = [entry for section in config.nav for entry in [*section.values()][0]]
    for entry in sections:
        if isinstance(entry, dict) and 'Examples' in entry:
            others = [{Path(page).stem: page} for page in pages if page != first]
            entry['Examples'] = [{'All examples': first}, *others]
    config.site_name += f' {VERSION}'
    if MERMAID not in LIBRARIES:
        config.mdx_configs['pymdownx.superfences']['custom_fences'] = []
    return config


def on_files(files, config):
    """Add the pages of the repository, those of the gallery, and the files that pages link to."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text('utf-8')))
    for name, path in LIBRARIES.items():
        files.append(File.generated(config, name, abs_src_path=str(path)))
    for path in sorted(GALLERY.rglob('*')):
        shown = path.suffix in ('.md', '.png', '.svg', '.gif', '.html', '.csv', '.ipynb')
        if path.is_file() and shown:
            place = f'gallery/{path.relative_to(GALLERY).as_posix()}'
            files.append(File.generated(config, place, abs_src_path=str(path)))
    for source in [*PAGES, *(f'docs/{path.name}' for path in (ROOT / 'docs').glob('*.md'))]:
        for _, link, _ in LINK.findall((ROOT / source).read_text('utf-8')):
            target = _file_of(link, source)
            place = _place(target) if target else ''
            if place.startswith('source/') and place not in files.src_uris:
                files.append(File.generated(config, place, abs_src_path=str(ROOT / target)))
    return files


def on_page_markdown(markdown, page, **_):
    """Return a page with its links to files of the repository as links within the site."""
    here = page.file.src_uri
    source = next((name for name, own in PAGES.items() if own == here), f'docs/{here}')
    if source == 'CHANGELOG.rst':
        # Its headings, lists and marks are those of Markdown, but for the title.
        markdown = re.sub(r'^\^+\n(.*)\n\^+\n', r'# \1\n', markdown).replace('``', '`')
    if here.startswith('gallery/'):
        return markdown

    def moved(match):
        target = _file_of(match[2], source)
        if not target:
            return match[0]
        link = os.path.relpath(_place(target), PurePosixPath(here).parent)
        anchor = match[2].partition('#')[1:]
        return f'{match[1]}{link}{"".join(anchor)}{match[3]}'

    return LINK.sub(moved, markdown)


def on_post_page(output, page, **_):
    """Return a page with scripts of this site only, and those for diagrams where it has some."""
    output = _local(output, page.file.dest_uri)
    if 'class="mermaid"' in output:
        output = output.replace('</head>', f'{_script(page.file.dest_uri, MERMAID)}</head>', 1)
        diagram = r'<pre class="mermaid">.*?</pre>'
        output = re.sub(diagram, r'<div class="result">\g<0></div>', output, flags=re.DOTALL)
    return output


def on_post_template(output, template_name, **_):
    """Do the same for the pages of the theme, such as that of a dead link."""
    return _local(output, template_name)


def _local(output, place):
    remote = '<script src="https://unpkg.com/iframe-worker/shim"></script>'
    return output.replace(remote, _script(place, SHIM))


def _script(place, name):
    if name not in LIBRARIES:
        return ''
    source = os.path.relpath(name, PurePosixPath(place).parent)
    return f'<script src="{source}"></script>'


def _file_of(link, source):
    """Return the path in the repository of what a page links to; None for other links."""
    name = link.partition('#')[0]
    if not name or re.match(r'[a-z]+:', name):
        return None
    path = os.path.normpath(PurePosixPath(source).parent / name)
    return path if (ROOT / path).is_file() else None


def _place(path):
    """Return the place in the site of a file of the repository."""
    if path in PAGES:
        return PAGES[path]
    return path.removeprefix('docs/') if path.startswith('docs/') else f'source/{path}'
