"""Pages of the site that are not in docs/: README.md, CONTRIBUTING.md, and the parameters.

And the docstrings below the table of the Python interface.
"""

import re
from dataclasses import fields
from pathlib import Path

from mkdocs.structure.files import File

from rangeseg_ros import Config

ROOT = Path(__file__).parents[1]
PAGES = {'README.md': 'index.md', 'CONTRIBUTING.md': 'contributing.md'}


def on_files(files, config):
    """Add the pages, their links as seen from docs/."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding='utf-8')
        text = re.sub(r'^\[!\[.*\n', '', text, flags=re.M)  # badges come from the network
        text = re.sub(r'\]\((?:docs/)?', '](', text)
        text = re.sub(r'\[([^]]+)\]\((?:LICENSE|CITATION.cff|CHANGELOG.rst)\)', r'\1', text)
        for other, name in PAGES.items():
            text = text.replace(f']({other}', f']({name}')
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, 'parameters.md', content=parameters()))
    return files


def on_page_markdown(markdown, page, **_):
    """Add what the docstrings say of the names in the table of api.md."""
    if page.file.src_uri != 'api.md':
        return markdown
    parts = [markdown]
    for name in re.findall(r'^\| `(\w+)`', markdown, re.M):
        # Its fields are the page of the parameters.
        members = '\n    options:\n      members: [from_mapping]' * (name == 'Config')
        parts += [f'::: rangeseg_ros.{name}{members}'] * (name != 'ROLES')
    return '\n\n'.join(parts)


def parameters():
    """Table of all parameters, as `Config` has them."""
    rows = [
        '# Parameters\n\nOf the segmenter: fields of `Config` in Python, names in the files of '
        '`--params`, parameters of the node.\n\n| parameter | meaning |\n|---|---|'
    ]
    for option in fields(Config):
        low, high, choices = (option.metadata[key] for key in ('low', 'high', 'choices'))
        takes = ', '.join(f'`{choice}`' for choice in choices) or 'true or false'
        if low is not None:
            takes = f'{low:g} to {high:g}'
        description = option.metadata['description'].replace('|', '\\|')
        takes += f'; default `{option.default}`'
        rows.append(f'| `{option.name}` | {description} ({takes}) |')
    return '\n'.join(rows) + '\n'
