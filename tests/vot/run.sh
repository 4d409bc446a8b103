#!/usr/bin/env bash
# Drives `tsda trax` with the real VOT toolkit and with libtrax, the protocol's own library, on clips
# that the project draws itself. Not part of scripts/test.sh: the toolkit is a 600 MB installation.
#
#   tests/vot/run.sh            # builds what is missing, then runs everything (a few minutes)
#
# TSDA           a `tsda` to test, instead of building one
# TSDA_VOT_WORK  folder for the virtual environment, sequences and results; default <target>/vot
# TSDA_VOT_VENV  virtual environment, made when it is not there; default <work>/venv
#
# The toolkit exits with 0 also when a tracker crashes, so this script looks for the line it concludes
# with and for the files it writes. Nothing is skipped: what cannot be done ends the script.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
cd "$here/../.."

target="${CARGO_TARGET_DIR:-target}"
work="${TSDA_VOT_WORK:-$target/vot}"
mkdir -p "$work"
work="$(cd "$work" && pwd)"
venv="${TSDA_VOT_VENV:-$work/venv}"
frames=60
# Later versions do not run multistart and realtime, or do not import (see docs/trax.md).
want=(vot-toolkit==0.7.4 vot-trax==4.0.2 attributee==0.1.9)

fail() { echo "tests/vot: FAILED: $*" >&2; exit 1; }
step() { echo "== $*"; }

# --- the toolkit -------------------------------------------------------------------------------
installed() {
  [ -x "$venv/bin/python" ] && "$venv/bin/python" - "${want[@]}" <<'PY' 2>/dev/null
import importlib.metadata, sys
for requirement in sys.argv[1:]:
    name, version = requirement.split("==")
    assert importlib.metadata.version(name) == version
import trax, vot
PY
}

if installed; then
  step "toolkit: ${want[*]} in $venv"
else
  step "toolkit: installing ${want[*]} into $venv"
  command -v python3 >/dev/null || fail "python3 is not installed"
  [ -x "$venv/bin/python" ] || python3 -m venv "$venv" || fail "python3 has no venv module"
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "${want[@]}" \
    || fail "pip could not install ${want[*]}: without network, point TSDA_VOT_VENV to a virtual environment that has them"
  installed || fail "$venv does not hold ${want[*]} after installing them"
fi
vot() { "$venv/bin/vot" "$@"; }

# --- the tracker and the sequences --------------------------------------------------------------
if [ -n "${TSDA:-}" ]; then
  [ -x "$TSDA" ] || fail "TSDA=$TSDA is not a program"
  tsda="$(cd "$(dirname "$TSDA")" && pwd)/$(basename "$TSDA")"
else
  step "building tsda"
  cargo build --quiet --locked -p tsda-host --bin tsda || fail "tsda cannot be built"
  tsda="$(cd "$target/debug" && pwd)/tsda"
fi
ws="$work/workspace"
rm -rf "$ws"
mkdir -p "$ws"
"$tsda" render --out "$ws/sequences" --frames "$frames"
sequences=$(wc -l < "$ws/sequences/list.txt")
step "tracker: $tsda; $sequences sequences of $frames frames"

cp "$here/stack.yaml" "$ws/stack.yaml"
printf 'registry: [./trackers.ini]\nstack: ./stack.yaml\nsequences: ./sequences\n' > "$ws/config.yaml"
tracker() { # name, options, further lines
  printf '[%s]\nlabel = %s\nprotocol = trax\ncommand = "%s" trax %s\ntimeout = 120\n%s\n' "$1" "$1" "$tsda" "$2" "${3:-}"
}
{
  tracker TsdaColor ""
  tracker TsdaSocket "--trax-version 3" "socket = true"
  tracker TsdaV1 "--trax-version 1"
  tracker TsdaRgbt "--channels color,ir --policy auto"
  tracker TsdaBroken "--bundle /nowhere/none.tsda"
} > "$ws/trackers.ini"
evaluated=(TsdaColor TsdaSocket TsdaRgbt)

# --- 1: libtrax as the client -------------------------------------------------------------------
step "libtrax sessions"
"$venv/bin/python" "$here/client.py" "$tsda" "$ws/sequences" || fail "sessions with libtrax"

# --- 2: vot test --------------------------------------------------------------------------------
# Runs the toolkit; its output is kept in a log, and shown when something is wrong.
toolkit() { # log, command...
  local log="$work/$1.log"
  shift
  (cd "$ws" && VOT_RESULTS_BINARY=0 vot "$@") > "$log" 2>&1 || { cat "$log"; fail "vot $* ended with an error"; }
}
concluded() { # log, line
  grep -q "$2" "$work/$1.log" || { cat "$work/$1.log"; fail "$1: no line \"$2\""; }
}
step "vot test"
for name in TsdaColor TsdaSocket TsdaV1; do
  toolkit "test-$name" test "$name"
  concluded "test-$name" "Test concluded successfuly"
  echo "  $name on the toolkit's own sequence: passed"
done
for name in TsdaColor TsdaRgbt; do
  toolkit "test-$name-rgbt" test --sequence sequences/rgbt "$name"
  concluded "test-$name-rgbt" "Test concluded successfuly"
  echo "  $name on sequences/rgbt: passed"
done
# The check itself must be able to fail, and the user must be told why.
(cd "$ws" && vot test TsdaBroken) > "$work/test-TsdaBroken.log" 2>&1 || true
if grep -q "Test concluded successfuly" "$work/test-TsdaBroken.log"; then
  fail "a tracker without a model passes vot test"
fi
concluded test-TsdaBroken "/nowhere/none.tsda"
echo "  TsdaBroken: refused, with the tracker's reason"

# --- 3: vot evaluate ----------------------------------------------------------------------------
step "vot evaluate: unsupervised, multistart, realtime, supervised"
started=$SECONDS
toolkit evaluate evaluate --workspace "$ws" "${evaluated[@]}"
concluded evaluate "Evaluation concluded successfuly"
echo "  concluded after $((SECONDS - started)) s"

# --- 4: vot analysis, report --------------------------------------------------------------------
step "vot analysis, report"
toolkit analysis analysis --workspace "$ws" --format json --name figures "${evaluated[@]}"
toolkit report report --workspace "$ws" --format html --name report "${evaluated[@]}"
page="$(find "$ws/reports" -name '*.html' 2>/dev/null | head -n 1)"
[ -n "$page" ] && [ -s "$page" ] || { cat "$work/report.log"; fail "vot report wrote no page"; }
for name in "${evaluated[@]}"; do
  grep -q "$name" "$page" || fail "$page does not name $name"
done
echo "  report: $page"

# --- 5: what was written ------------------------------------------------------------------------
step "results"
"$venv/bin/python" "$here/check.py" "$ws" "$frames" "${evaluated[@]}" || fail "results are not what they should be"
echo "tests/vot: passed"
