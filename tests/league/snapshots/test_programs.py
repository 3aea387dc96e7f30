"""Programs of others as players of a league: brought in, rated beside its own, refused with one line, and at fault."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch

import arenas
from agents.policy.networks import Actor
from agents.settings import Architecture
from league import Policy
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runtime.bootstrap import create
from league.snapshots.codec import freeze, thaw
from league.snapshots.programs import exporting
from league.snapshots.programs.model import ProgramError
from league.snapshots.programs.stored import host_policies, of_bytes, parameters, read
from league.state.jobs import RatingMatch
from storage.errors import StorageError
from storage.maintenance.verify import verify
from storage.records import Player, Snapshot
from storage.store import Store
from tests.league.conftest import ROOT
from tests.league.snapshots.test_policy_file import ran

RPS = arenas.settings("rock-paper-scissors")
ROSTER = "chooser:1:3"
ROCK = "import numpy as np\n\ndef rock(x):\n    return np.tile([1.0, 0, 0], (len(x), 1))\n"
BROKEN = """import numpy as np

def paper_then_nan(x):
    return np.tile([0, np.nan if len(x) == 16 else 1.0, 0], (len(x), 1))
"""  # in the groups of the evaluator below


def gemm(path, sees: int = 1, acts: int = 3, rows="N", name: str = "observations", bias=(0.0, 1.0, 0.0)):
    """An ONNX file of one layer, which always chooses paper."""
    kind, helper = onnx.TensorProto.FLOAT, onnx.helper
    weights = [
        onnx.numpy_helper.from_array(np.zeros((sees, acts), np.float32), "w"),
        onnx.numpy_helper.from_array(np.resize(np.float32(bias), acts), "b"),
    ]
    ends = [helper.make_tensor_value_info(*end) for end in ((name, kind, [rows, sees]), ("y", kind, [rows, acts]))]
    node = helper.make_node("Gemm", [name, "w", "b"], ["y"])
    graph = helper.make_graph([node], "g", ends[:1], ends[1:], initializer=weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return str(path)


def fresh(seed: int) -> bytes:
    torch.manual_seed(seed)
    actor = Actor(1, 3, Architecture((8,)), 0.8)
    return freeze([{name: tensor.numpy() for name, tensor in actor.state_dict().items()}])


@pytest.fixture(scope="module")
def arena():
    return RPS.build(engine="auto", threads=1)


@pytest.fixture(scope="module")
def config():
    config = Config(arena=RPS)
    return replace(config, rating=replace(config.rating, worlds=64, pairings=2, episodes_per_pair=16, trained=False))


@pytest.fixture(scope="module")
def evaluator(config, arena):
    return MatchEvaluator(config, arena, "main")


@pytest.fixture
def home(tmp_path, config, arena):
    """A league of two players who have never learnt, and of scripts."""
    settings = configuration.dumps(config)
    with Store.open(tmp_path / "home", create=True) as store:
        create(store, config, arena)
        store.add_players([Player("main", name, team, "main", ROSTER) for team, name in enumerate(("blue", "red"))])
        store.add_snapshots([
            Snapshot("main", f"{name}@0", store.blobs.put(fresh(team)), ROSTER, name, initial=True, settings=settings)
            for team, name in enumerate(("blue", "red"))
        ])  # fmt: skip
        yield store


@pytest.fixture
def use(tmp_path, capsys):
    """Run a command on that store."""
    return lambda *args, code=0: ran(capsys, *args, "--store", str(tmp_path / "home"), code=code)


def test_a_policy_goes_out_as_onnx_comes_in_again_and_is_rated_like_itself(home, use, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = use("export", "blue@0", "--onnx", "--torchscript", "-o", "b.safetensors")
    assert "to b.safetensors" in said
    assert "b.onnx, b.pt, card b.safetensors.md" in said
    card = (tmp_path / "b.safetensors.md").read_text()
    assert "Its rate: 1 decision per second" in card
    assert "| rock | 0 |  | any | the largest of these numbers is the choice |" in card
    names: dict = {}
    exec(re.findall(r"```python\n(.*?)```", card, re.DOTALL)[0], names)
    model = onnx.load("b.onnx")
    assert [each.name for each in model.graph.input] == ["observations", "noise"]
    session = __import__("onnxruntime").InferenceSession("b.onnx")
    seen, noise = np.ones((4, 1), np.float32), np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    (actions,) = session.run(None, {"observations": seen, "noise": noise})
    np.testing.assert_allclose(names["act"](seen, noise), actions, atol=1e-5)
    assert "all worlds at once" in use("import", "b.onnx", "--as", "twin", "--team", "blue")
    use("import", "b.pt", "--as", "sister")
    told = use("rate", "--among", "twin,sister", "--episodes", "192", "--budget", "5m")
    assert "Played 192 episodes" in told or "Played 256 episodes" in told
    twins = [m for m in home.matches("main") if {m.a, m.b} <= {"twin", "blue@0", "sister"}]
    assert sum(m.wins + m.losses for m in twins) > 0
    assert all(m.wins == m.losses and not m.voids for m in twins)  # the same play in swapped seats, seed by seed
    assert not verify(str(tmp_path / "home")).findings


def test_a_program_at_fault_forfeits_is_told_once_and_the_others_play_on(home, use, tmp_path, evaluator, capsys):
    (tmp_path / "rock.py").write_text(ROCK)
    (tmp_path / "broken.py").write_text(BROKEN)
    assert "Python code" in use("import", f"{tmp_path}/rock.py:rock", "--as", "stone")
    use("import", f"{tmp_path}/broken.py:paper_then_nan", "--as", "broken")
    pairs = ("broken", "stone"), ("paper", "stone")
    bad, good = evaluator.play(home, RatingMatch(pairs, 5, record=False))
    assert (good.wins, good.voids) == (32, 0)
    assert bad.voids == bad.voids_a > 0
    assert bad.voids_b == 0
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"broken ({tmp_path}/broken.py:paper_then_nan), agent 0 returned actions that are not finite" in err
    (tmp_path / "rock.py").write_text(ROCK.replace("[1.0, 0, 0]", "[0, 0, 1.0]"))
    stone = next(s for s in home.snapshots("main") if s.name == "stone")
    with pytest.raises(StorageError, match="has changed since rock was imported"):
        thaw(home, stone, evaluator.arena)


def test_programs_that_take_one_world_at_a_time_are_called_in_a_loop(home, use, tmp_path, evaluator):
    assert "one world at a time" in use("import", gemm(tmp_path / "one.onnx", rows=1), "--as", "one")
    (tmp_path / "mine.py").write_text("def scissors(x):\n    return [0.0 * x[0], 0.0, 1.0]\n")
    assert "one world at a time" in use("import", f"{tmp_path}/mine.py:scissors", "--as", "mine")
    (match, _) = evaluator.play(home, RatingMatch((("one", "mine"), ("rock", "paper")), 5, record=False))
    assert (match.losses, match.voids) == (32, 0)  # scissors cut paper


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
def test_what_is_no_policy_of_the_team_is_refused_in_one_line(home, use, tmp_path):
    (tmp_path / "nan.py").write_text(
        "def nan(x):\n    return x.repeat(3, 1) * float('nan')\n\ndef wide(x):\n    return x\n"
    )
    torch.save({"w": torch.zeros(2)}, tmp_path / "state.pt")
    torch.jit.script(torch.nn.Linear(4, 3)).save(tmp_path / "wide.pt")
    (tmp_path / "text.onnx").write_text("this is no protobuf")
    (tmp_path / "text").write_text("this is nothing")
    refused = {
        gemm(tmp_path / "wide.onnx", sees=4): "input observations has 4 numbers, and a chooser of this team sees 1",
        gemm(tmp_path / "acts.onnx", acts=2): "output y has 2 numbers, and a chooser of this team acts with 3",
        f"{tmp_path}/text.onnx": "is no ONNX file that onnxruntime can load",
        f"{tmp_path}/state.pt": "is no TorchScript file",
        f"{tmp_path}/wide.pt": "observations (3, 1) raise RuntimeError: mat1 and mat2 shapes cannot be multiplied",
        f"{tmp_path}/text": "is no policy that `league export` wrote, nor",
        f"{tmp_path}/none.onnx": "none.onnx",
        f"{tmp_path}/nan.py": "nan.py:function",
        f"{tmp_path}/nan.py:nan": "give actions that are not finite numbers",
        f"{tmp_path}/nan.py:wide": "a batch of 3 gave shape (3, 1)",
        f"{tmp_path}/nan.py:lost": "has no function or class 'lost'",
        f"{tmp_path}/away.py:act": "there is no file",
        f"{tmp_path}/acts.onnx,{tmp_path}/wide.pt": "give programs of one kind, x.onnx, x.pt or x.py:function",
        f"{tmp_path}/wide.onnx,{tmp_path}/wide.onnx": "2 files for the 1 agents",
    }
    for named, why in refused.items():
        assert why in use("import", named, "--as", "x", code=2), named
    assert "no team 'green'" in use("import", f"{tmp_path}/nan.py:nan", "--as", "x", "--team", "green", code=2)
    use("import", gemm(tmp_path / "ok.onnx", name="any_name"), "--as", "ok")
    assert "has a player or snapshot of that name" in use("import", f"{tmp_path}/ok.onnx", "--as", "blue", code=2)


def test_weights_in_a_file_beside_it_become_part_of_the_policy(tmp_path):
    def policy(name: str, bias: tuple[float, ...]) -> str:
        model = onnx.load(gemm(tmp_path / "inside.onnx", bias=bias))
        folder = tmp_path / name
        folder.mkdir()
        onnx.save(model, folder / "p.onnx", save_as_external_data=True, location="p.onnx.data", size_threshold=0)
        return str(folder / "p.onnx")

    paper, rock = policy("paper", (0.0, 1.0, 0.0)), policy("rock", (1.0, 0.0, 0.0))
    bare = (tmp_path / "rock" / "p.onnx").read_bytes()
    assert (tmp_path / "paper" / "p.onnx").read_bytes() == bare  # the weights alone differ
    programs = {name: read("onnx", [name], ROSTER) for name in (paper, rock)}
    (tmp_path / "rock" / "p.onnx.data").unlink()
    with pytest.raises(StorageError, match=r"keeps its weights in p\.onnx\.data, which cannot be read beside it"):
        read("onnx", [rock], ROSTER)
    for name, choice in ((paper, 1), (rock, 0)):
        (only,) = host_policies(programs[name].to_bytes(), "guest")
        seen, noise = np.ones((2, 1), np.float32), np.zeros((2, 3), np.float32)
        assert only.act("a", 0, seen, noise, np.ones(2, bool)).argmax(1).tolist() == [choice] * 2
    with pytest.raises(StorageError, match="save the weights in the file itself"):
        of_bytes([("p.onnx", bare)], ROSTER)


def test_bytes_are_never_completed_by_a_file_of_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = onnx.load(gemm(tmp_path / "inside.onnx"))
    onnx.save(model, "p.onnx", save_as_external_data=True, location="p.onnx.data", size_threshold=0)
    with pytest.raises(StorageError, match="save the weights in the file itself"):
        of_bytes([("p.onnx", (tmp_path / "p.onnx").read_bytes())], ROSTER)


def test_a_policy_that_divides_by_what_it_sees_is_taken_and_one_that_is_never_finite_is_not(tmp_path):
    (tmp_path / "own.py").write_text(
        "import numpy as np\n\n"
        "def distance(seen):\n    return np.tile(1.0 / seen, (1, 3))\n\n"
        "def never(seen):\n    return np.full((len(seen), 3), np.nan)\n"
    )
    assert read("python", [f"{tmp_path}/own.py:distance"], ROSTER).kind == "python"
    with pytest.raises(ProgramError, match="give actions that are not finite numbers; clip what it divides by"):
        read("python", [f"{tmp_path}/own.py:never"], ROSTER)


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
def test_parameters_are_counted_wherever_they_stand(tmp_path):
    class Layer(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(1, 3)

        def forward(self, observations: torch.Tensor) -> torch.Tensor:
            return self.layer(observations)

    scripted = torch.jit.script(Layer().eval())
    scripted.save(str(tmp_path / "p.pt"))
    torch.jit.freeze(scripted).save(str(tmp_path / "frozen.pt"))
    model = onnx.load(gemm(tmp_path / "p.onnx"))
    constants = [
        onnx.helper.make_node("Constant", [], [each.name], value=each) for each in model.graph.initializer
    ]  # fmt: skip
    del model.graph.initializer[:]
    nodes = [*constants, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, tmp_path / "constants.onnx")
    (tmp_path / "rock.py").write_text(ROCK)
    files = {"p.pt": 6, "frozen.pt": 6, "p.onnx": 6, "constants.onnx": 6, "rock.py:rock": 0}
    kinds = {"pt": "torchscript", "onnx": "onnx", "py:rock": "python"}
    for name, count in files.items():
        kind = kinds[name.partition(".")[2]]
        assert parameters(read(kind, [f"{tmp_path}/{name}"], ROSTER)) == count, name


def test_one_file_serves_all_agents_or_each_has_its_own(home, tmp_path):
    paper, rock = gemm(tmp_path / "p.onnx"), gemm(tmp_path / "r.onnx", bias=(1.0, 0.0, 0.0))
    seat = SimpleNamespace(seen=np.ones((2, 1), np.float32), noise=np.zeros((2, 3), np.float32))
    for names, choices in (([paper], [1, 1]), ([paper, rock], [1, 0])):
        policies = host_policies(read("onnx", names, f"{ROSTER}+{ROSTER}").to_bytes(), "pair")
        acted = [p.act("a", 0, seat.seen, seat.noise, np.ones(2, bool)).argmax(1).tolist() for p in policies]
        assert acted == [[choice] * 2 for choice in choices]
    with Open(home, "main") as opened:
        assert not [s for s in opened.store.snapshots("main") if s.origin == "imported"]


def test_a_program_goes_out_as_the_file_that_it_was(home, use, tmp_path):
    file, again = tmp_path / "mine.onnx", tmp_path / "again.onnx"
    gemm(file)
    use("import", str(file), "--as", "mine", "--team", "blue")
    assert "again.onnx" in use("export", "mine", "-o", str(again))
    assert again.read_bytes() == file.read_bytes()
    assert "again.onnx" in use("export", "mine", "-o", str(again), code=2)  # never over another file
    assert "add --onnx" in use("export", "blue@0", "-o", str(tmp_path / "blue.onnx"), code=2)
    assert "no card is known" in use("export", "mine", "-o", str(tmp_path / "m"), "--card", "m.md", code=2)
    assert "cannot be written as torchscript" in use("export", "mine", "--torchscript", code=2)
    (tmp_path / "rock.py").write_text(ROCK)
    use("import", f"{tmp_path}/rock.py:rock", "--as", "rock-again", "--team", "blue")
    assert "no code is stored" in use("export", "rock-again", "-o", str(tmp_path / "rock"), code=2)


def test_each_agent_of_a_program_has_its_own_file_again(home, tmp_path):
    names = [gemm(tmp_path / "p.onnx"), gemm(tmp_path / "r.onnx", bias=(1.0, 0.0, 0.0))]
    pair = read("onnx", names, f"{ROSTER}+{ROSTER}")
    both, digest = f"{ROSTER}+{ROSTER}", home.blobs.put(pair.to_bytes())
    home.add_snapshots([Snapshot("main", "pair", digest, both, origin="imported")])
    with Open(home, "main") as opened:
        found = exporting.files(opened, "pair", tmp_path / "out")
        assert exporting.files(opened, "blue@0", tmp_path / "out") is None
    assert found == {tmp_path / f"out-{i}.onnx": Path(name).read_bytes() for i, name in enumerate(names)}


def test_a_policy_in_python_plays_without_being_stored(home, tmp_path):
    seen: list[int] = []

    class Paper:
        def reset(self, first):
            seen.append(len(first))

        def __call__(self, x):
            return np.tile([0.0, 1.0, 0.0], (len(x), 1))

    with Open(home, "main") as opened:
        score = Policy.from_callable(Paper()).play(opened, "rock", episodes=16)
        assert (score.score, score.games, score.voids) == (1.0, 16, 0)
        assert set(seen) == {3, 8}  # the trial, and each of the two sides
        assert not opened.store.matches("main")
        with pytest.raises(ConfigError, match=r"^episodes = 0: give a whole number of 1 or more$"):
            Policy.from_callable(Paper()).play(opened, "rock", episodes=0)
        with pytest.raises(ConfigError, match="put it in a file"):
            Policy.from_callable(Paper()).add_to(opened, "paper-again")
        assert Policy.from_file(gemm(tmp_path / "p.onnx")).add_to(opened, "mine", "red").roster == ROSTER


def test_importing_the_package_loads_nothing_heavy():
    loaded = "import sys, league; print([m for m in ('jax', 'torch', 'numpy', 'onnxruntime') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, cwd=ROOT).stdout == "[]\n"
