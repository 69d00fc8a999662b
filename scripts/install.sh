#!/bin/sh
# install.sh VENV REQUIREMENT: make VENV if needed and install the project into it, editable, with pinned
# versions. Without an NVIDIA driver torch comes as its CPU build, which is a tenth of the size.
set -eu
venv=$1 requirement=$2
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "error: $("$python" --version) is too old; set PYTHON to a Python of 3.11 or newer" >&2
    exit 2
}
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip() { "$venv/bin/python" -m pip --disable-pip-version-check "$@"; }

torch=$(sed -n 's/^torch==//p' constraints.txt)
if ! "$venv/bin/python" -c 'import torch' 2>/dev/null; then
    echo "installing torch $torch"
    if command -v nvidia-smi >/dev/null 2>&1 && nvidia-smi >/dev/null 2>&1; then
        pip install -q "torch==$torch"
    else
        pip install -q "torch==$torch+cpu" 2>/dev/null ||
            pip install -q "torch==$torch" --index-url https://download.pytorch.org/whl/cpu 2>/dev/null ||
            pip install -q "torch==$torch"
    fi
fi
echo "installing $requirement"
pip install -q -c constraints.txt -e "$requirement"
