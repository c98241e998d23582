"""The folder of cached programs: whose it must be."""

import os
import subprocess
import sys

import jax
import pytest

import jaxvib as jv
from jaxvib import InputError
from jaxvib.runtime import cache

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a folder has one owner on POSIX only")
root_only = pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() != 0, reason="only root can give a folder away")


@pytest.fixture(autouse=True)
def _unchanged():
    cache.set_program_folder(None)
    yield
    cache.set_program_folder(None)


def test_an_own_folder_is_used_and_closed_to_others(tmp_path):
    assert jv.use_cache(tmp_path / "new") == tmp_path / "new"
    assert cache.program_folder() == tmp_path / "new" / "programs"
    assert (tmp_path / "new" / "programs").stat().st_mode & 0o077 == 0


def test_a_chosen_folder_is_kept_if_only_an_unset_one_is_set(tmp_path):
    assert jv.use_cache(tmp_path / "first", only_if_unset=True) == tmp_path / "first"
    assert jv.use_cache(tmp_path / "second", only_if_unset=True) == tmp_path / "first"
    assert cache.program_folder() == tmp_path / "first" / "programs" and not (tmp_path / "second").exists()
    assert jv.use_cache(tmp_path / "third") == tmp_path / "third"
    assert cache.program_folder() == tmp_path / "third" / "programs"


@pytest.mark.parametrize("mode", [0o775, 0o757, 0o1777])
@pytest.mark.parametrize("part", [".", "programs"])
def test_a_folder_others_can_write_to_is_refused(tmp_path, mode, part):
    folder = tmp_path / "shared"
    (folder / "programs").mkdir(parents=True)
    (folder / part).chmod(mode)
    with pytest.raises(InputError, match=r"others can write to.*chmod go-w"):
        jv.use_cache(folder)
    assert cache.program_folder() is None


def test_a_folder_that_others_can_exchange_is_refused(tmp_path):
    """Whoever may write to the folder above can rename this one; not where the sticky bit is set, as in /tmp."""
    above = tmp_path / "above"
    (above / "own").mkdir(parents=True)
    above.chmod(0o777)
    with pytest.raises(InputError, match="above', which is not safe; run chmod"):
        jv.use_cache(above / "own")
    above.chmod(0o1777)
    jv.use_cache(above / "own")


@root_only
@pytest.mark.parametrize("part", [".", "programs", ".."])
def test_a_folder_of_another_user_is_refused(tmp_path, part):
    folder = tmp_path / "above" / "foreign"
    (folder / "programs").mkdir(parents=True)
    os.chown(folder / part, 12345, -1)
    with pytest.raises(InputError, match=r"must belong to you.*belongs to user 12345"):
        jv.use_cache(folder)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="must be a folder that can be written to"):
        jv.use_cache(tmp_path / "file")


def test_a_link_is_judged_by_where_it_leads(tmp_path):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o777)
    (tmp_path / "link").symlink_to(tmp_path / "shared")
    with pytest.raises(InputError, match="others can write to"):
        jv.use_cache(tmp_path / "link")


CODE = """
import sys, jax
before = jax.config.jax_compilation_cache_dir
import jaxvib as jv
assert jax.config.jax_compilation_cache_dir == before
print(jv.use_cache(), jax.config.jax_compilation_cache_dir)
"""


@pytest.mark.parametrize("theirs", [True, False])
def test_the_default_is_the_users_cache(tmp_path, theirs):
    """A folder that JAX has been given already stays JAX's, and ours lies within it."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": str(tmp_path)} | ({"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "j")} if theirs else {})
    done = subprocess.run([sys.executable, "-c", CODE], env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.split() == [str(tmp_path / ("j" if theirs else "jaxvib"))] * 2


@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"])
def test_the_command_line_goes_on_without(tmp_path, variable):
    (tmp_path / "jaxvib").mkdir()
    (tmp_path / "jaxvib").chmod(0o777)
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment[variable] = str(tmp_path if variable == "XDG_CACHE_HOME" else tmp_path / "jaxvib")
    code = "from jaxvib.cli import prepare; prepare(); import jax; print(jax.config.jax_compilation_cache_dir)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert "programs are not cached" in done.stderr and done.stdout.strip() == "None"


def test_the_setting_of_this_process_is_left_alone(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jv.use_cache(tmp_path / "new")
    assert before is not None and jax.config.jax_compilation_cache_dir == before
