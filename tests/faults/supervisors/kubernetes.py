"""The manifests of `deploy/` given to a real Kubernetes API server, with its controllers and its scheduler.

    python -m tests.faults.supervisors.kubernetes --programs FOLDER --out tests/faults/results/kubernetes-cpu.json

FOLDER holds `etcd`, `kube-apiserver`, `kube-controller-manager`, `kube-scheduler` and `kubectl`; without it they are
taken from PATH. Debian packages `etcd-server`, and has the sources of the others: `apt-get source kubernetes` in
bookworm, and there `make WHAT="cmd/kube-apiserver cmd/kube-controller-manager cmd/kube-scheduler cmd/kubectl"` with its
Go 1.19. All listen on 127.0.0.1 and keep what they write in a folder of their own.

The server must hold every value of the manifests, and refuse what no league can be. Nodes and a volume are only named
to it: the scheduler gives each pod a node, and no kubelet runs it. Exit code 1 if it answers otherwise, 2 where a
program is missing.
"""

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from league.system import exit_codes
from scripts.record import commit, make_parser, write
from tests.faults.hunted import ROOT, Lost
from tests.faults.servers import await_port, free_port

PROGRAMS = ("etcd", "kube-apiserver", "kube-controller-manager", "kube-scheduler", "kubectl")
MANIFESTS = ROOT / "deploy" / "league.yaml"
TOKEN = "of-this-run-alone"
NODES = 4


def manifests() -> list[dict[str, Any]]:
    """Return the manifests, one of each kind and name."""
    return list(yaml.safe_load_all(MANIFESTS.read_text()))


class Cluster:
    """An API server, its etcd, controllers and a scheduler, all processes of this machine."""

    def __init__(self, programs: dict[str, str], folder: Path):
        self._programs, self._folder = programs, folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._port, at = free_port(), [free_port(), free_port()]
        key, tokens, settings = folder / "key", folder / "tokens", folder / "settings"
        subprocess.run(["openssl", "genrsa", "-out", key, "2048"], check=True, capture_output=True)
        tokens.write_text(f"{TOKEN},admin,1,system:masters\n")
        client, peers = (f"http://127.0.0.1:{port}" for port in at)
        self._run(
            "etcd", f"--data-dir={folder}/etcd", f"--listen-client-urls={client}", f"--advertise-client-urls={client}",
            f"--listen-peer-urls={peers}", f"--initial-advertise-peer-urls={peers}",
            f"--initial-cluster=default={peers}",
        )  # fmt: skip
        await_port(at[0])
        self._run(
            "kube-apiserver", f"--etcd-servers={client}", f"--secure-port={self._port}", "--bind-address=127.0.0.1",
            f"--cert-dir={folder}/certificates", f"--token-auth-file={tokens}", "--authorization-mode=RBAC",
            "--service-cluster-ip-range=10.0.0.0/24", "--endpoint-reconciler-type=none",
            "--service-account-issuer=https://league.local", f"--service-account-key-file={key}",
            f"--service-account-signing-key-file={key}",
        )  # fmt: skip
        settings.write_text(json.dumps(self._client_settings()))
        self.wait(lambda: self.ask("get", "--raw=/readyz")[1] == "ok", 120)
        common = [f"--kubeconfig={settings}", "--leader-elect=false", "--bind-address=127.0.0.1"]
        # No kubelet says that it lives.
        patience = ["--node-monitor-grace-period=10h", "--node-startup-grace-period=10h"]
        self._run(
            "kube-controller-manager", *common, *patience, f"--service-account-private-key-file={key}",
            "--use-service-account-credentials", f"--secure-port={free_port()}",
        )  # fmt: skip
        self._run("kube-scheduler", *common, f"--secure-port={free_port()}")
        self.wait(lambda: self.ask("get", "serviceaccount", "default")[0] == 0, 120)

    def _client_settings(self) -> dict[str, Any]:
        there = {"server": f"https://127.0.0.1:{self._port}"}
        there["certificate-authority"] = f"{self._folder}/certificates/apiserver.crt"
        return {
            "apiVersion": "v1", "kind": "Config", "current-context": "here",
            "clusters": [{"name": "here", "cluster": there}], "users": [{"name": "admin", "user": {"token": TOKEN}}],
            "contexts": [{"name": "here", "context": {"cluster": "here", "user": "admin"}}],
        }  # fmt: skip

    def _run(self, name: str, *flags: str) -> None:
        told = subprocess.run([self._programs[name], "--help"], capture_output=True, text=True, check=False).stdout
        if "--port int" in told:  # before 1.24 some also listen without encryption, on a port that others may have
            flags = (*flags, "--port=0")
        with (self._folder / f"{name}.log").open("wb") as out:
            call = [self._programs[name], *flags]
            self._processes.append(subprocess.Popen(call, stdout=out, stderr=out, cwd=self._folder))

    def ask(self, *words: str, given: Any = None) -> tuple[int, str]:
        """Run `kubectl`; return its exit code and what it prints. `given` are manifests on its standard input."""
        call = [self._programs["kubectl"], f"--kubeconfig={self._folder}/settings", f"--cache-dir={self._folder}/cache"]
        text = yaml.safe_dump_all(given) if isinstance(given, list) else json.dumps(given)
        done = subprocess.run([*call, *words], input=text, capture_output=True, text=True, timeout=120)
        return done.returncode, done.stdout + done.stderr

    def apply(self, given: list[dict[str, Any]]) -> tuple[int, str]:
        """Let the server take manifests, as it finds them: `kubectl` does not examine them."""
        return self.ask("apply", "--server-side", "--validate=false", "--filename=-", given=given)

    def get(self, *words: str) -> dict[str, Any]:
        """Return what the server holds. Raises Lost if it does not."""
        code, said = self.ask("get", *words, "--output=json")
        if code:
            raise Lost(said)
        return json.loads(said)

    def wait(self, until: Callable[[], Any], seconds: float) -> None:
        """Wait until `until()` is true. Raises Lost after so many seconds, or if a process has ended."""
        deadline = time.monotonic() + seconds
        while not until():
            ended = [str(each.args[0]) for each in self._processes if each.poll() is not None]  # type: ignore[index]
            if ended or time.monotonic() > deadline:
                raise Lost(f"ended: {ended}, after {seconds:.0f} s at most; {self.ask('get', 'pods')[1]}")
            time.sleep(0.3)

    def end(self) -> None:
        """End its processes, the last first."""
        for each in reversed(self._processes):
            each.terminate()
            with suppress(subprocess.TimeoutExpired):
                each.wait(20)
            each.kill()
            each.wait()


@contextmanager
def cluster(programs: dict[str, str], folder: Path) -> Iterator[Cluster]:
    """Yield a running cluster, and end it."""
    made = Cluster.__new__(Cluster)
    try:
        made.__init__(programs, folder)
        yield made
    finally:
        made.end()


# What it is asked -----------------------------------------------------------------------------------------------------


def held(on: Cluster) -> dict[str, int]:
    """Give it the manifests, twice; it must hold every value of them."""
    for _ in range(2):
        code, said = on.apply(manifests())
        if code:
            raise Lost(said)
    for given in manifests():
        kept = on.get(given["kind"], given["metadata"]["name"])
        if lacks := list(differences(given, kept, "")):
            raise Lost(f"{given['kind']} {given['metadata']['name']} is held otherwise: {lacks}")
    return {"manifests held": len(manifests())}


def differences(given: Any, kept: Any, at: str) -> Iterator[str]:
    """Yield the places at which a value that was given is not there."""
    if isinstance(given, dict) and isinstance(kept, dict):
        for name, value in given.items():
            yield from differences(value, kept.get(name), f"{at}.{name}")
    elif isinstance(given, list) and isinstance(kept, list) and len(given) == len(kept):
        for i, value in enumerate(given):
            yield from differences(value, kept[i], f"{at}[{i}]")
    elif given != kept:
        yield f"{at}: {given!r}, {kept!r}"


def _deployment() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the manager's manifest, and its container."""
    (made,) = [each for each in manifests() if each["metadata"]["name"] == "league" and each["kind"] == "Deployment"]
    return made, made["spec"]["template"]["spec"]["containers"][0]


# What cannot be: a change of the manager's specification and its container, and a word that the answer must have.
WRONG: dict[str, tuple[Callable[[dict[str, Any], dict[str, Any]], object], str]] = {
    "an unknown field": (lambda spec, _: spec.update(replicaz=1), "replicaz"),
    "an unknown field of a container": (lambda _, container: container.update(argz=[]), "argz"),
    "a number as text": (lambda spec, _: spec.update(replicas="one"), "replicas"),
    "a selector of other labels": (lambda spec, _: spec["selector"]["matchLabels"].update(app="x"), "selector"),
    "an unknown strategy": (lambda spec, _: spec["strategy"].update(type="Recreated"), "Recreated"),
    "no such quantity": (lambda _, container: container["resources"]["limits"].update(memory="32Gb"), "quantit"),
    "a volume that is not there": (lambda _, container: container["volumeMounts"][0].update(name="x"), "volumeMounts"),
}


def refused(on: Cluster) -> dict[str, int]:
    """Give it what cannot be; it must refuse each, and hold what it held."""
    before = on.get("deployment", "league")["metadata"]["generation"]
    for what, (change, word) in WRONG.items():
        manifest, container = _deployment()
        change(manifest["spec"], container)
        code, said = on.apply([manifest])
        print(f"  {what}: {said.strip().splitlines()[-1][:150]}", flush=True)
        if code == 0 or word not in said:
            raise Lost(f"{what}: {said}")
    if on.get("deployment", "league")["metadata"]["generation"] != before:
        raise Lost("a manifest that was refused has changed what it holds")
    return {"manifests refused": len(WRONG)}


def pods(on: Cluster) -> list[dict[str, Any]]:
    """Return the league's pods."""
    return on.get("pods", "--selector=app=league")["items"]


def placed(on: Cluster) -> dict[str, int]:
    """Name it nodes with a GPU each and a volume; the manager's pod and three workers' must get one node each."""
    code, said = on.ask("create", "secret", "generic", "league", "--from-literal=PGPASSWORD=x")
    if code:
        raise Lost(said)
    on.wait(lambda: len(pods(on)) == NODES, 60)
    if any(pod["spec"].get("nodeName") for pod in pods(on)):
        raise Lost("a pod has a node, where there is none")
    volume = {
        "apiVersion": "v1", "kind": "PersistentVolume", "metadata": {"name": "shared"},
        "spec": {
            "capacity": {"storage": "100Gi"}, "accessModes": ["ReadWriteMany"],
            "nfs": {"server": "nfs.example", "path": "/"},
        },
    }  # fmt: skip
    on.apply([volume])
    for i in range(NODES):
        _add_node(on, f"n{i}")
    on.wait(lambda: all(pod["spec"].get("nodeName") for pod in pods(on)), 120)
    if len({pod["spec"]["nodeName"] for pod in pods(on)}) != NODES:
        raise Lost("two pods share a GPU")
    return {"pods that got a node": NODES}


def _add_node(on: Cluster, name: str) -> None:
    """Name it a node that is ready, with a GPU."""
    space = {"cpu": "8", "memory": "64Gi", "pods": "10", "nvidia.com/gpu": "1", "ephemeral-storage": "100Gi"}
    status = {"capacity": space, "allocatable": space, "conditions": [{"type": "Ready", "status": "True"}]}
    node = {"apiVersion": "v1", "kind": "Node", "metadata": {"name": name}, "status": status}
    code, said = on.ask("create", "--validate=false", "--filename=-", given=[node])
    if code:
        raise Lost(said)


def replaced(on: Cluster) -> dict[str, int]:
    """Remove the manager's pod, as from a node that died; it is replaced, and never are there two."""
    (old,) = on.get("pods", "--selector=part=manager")["items"]
    on.ask("delete", "pod", old["metadata"]["name"], "--grace-period=0", "--force")
    on.wait(lambda: _managers(on) not in ([], [old["metadata"]["uid"]]), 60)
    return {"pods replaced": 1}


def renewed(on: Cluster) -> dict[str, int]:
    """Change the manager's image: its new pod must wait until the old one has gone."""
    (old,) = _managers(on)
    manifest, container = _deployment()
    container["image"] = "robot-league:next"
    if on.apply([manifest])[0]:
        raise Lost("another image is refused")
    seen = []
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:  # nothing confirms the old pod's end, as a kubelet that still ends it
        seen.append(_managers(on))
        time.sleep(0.5)
    if any(each != [old] for each in seen):
        raise Lost(f"a new manager came before the old one had gone: {seen}")
    (name,) = [pod["metadata"]["name"] for pod in pods(on) if pod["metadata"]["uid"] == old]
    on.ask("delete", "pod", name, "--grace-period=0", "--force")
    on.wait(lambda: _managers(on) not in ([], [old]), 60)
    return {"images changed": 1}


def rolled(on: Cluster) -> dict[str, int]:
    """Change the workers' image while every GPU is taken: all must get the new one."""
    (manifest,) = [each for each in manifests() if each["metadata"]["name"] == "league-worker"]
    manifest["spec"]["template"]["spec"]["containers"][0]["image"] = "robot-league:next"
    _act_as_kubelets(on)
    if on.apply([manifest])[0]:
        raise Lost("another image is refused")

    def renewed_all() -> bool:
        _act_as_kubelets(on)
        workers = on.get("pods", "--selector=part=worker")["items"]
        images = [pod["spec"]["containers"][0]["image"] for pod in workers if pod["spec"].get("nodeName")]
        return images == ["robot-league:next"] * manifest["spec"]["replicas"]

    on.wait(renewed_all, 90)
    return {"images of workers changed": manifest["spec"]["replicas"]}


def _act_as_kubelets(on: Cluster) -> None:
    """Say of pods that have a node that they run, and of those to be deleted that they have ended."""
    for pod in pods(on):
        name, ready = pod["metadata"]["name"], {"type": "Ready", "status": "True"}
        if "deletionTimestamp" in pod["metadata"]:
            on.ask("delete", "pod", name, "--grace-period=0", "--force")
        elif pod["spec"].get("nodeName") and ready["type"] not in [each["type"] for each in _conditions(pod)]:
            pod["status"] |= {"phase": "Running", "conditions": [*_conditions(pod), ready]}
            on.ask("replace", f"--raw=/api/v1/namespaces/default/pods/{name}/status", "--filename=-", given=pod)


def _conditions(pod: dict[str, Any]) -> list[dict[str, Any]]:
    return pod["status"].get("conditions", [])


def _managers(on: Cluster) -> list[str]:
    found = [pod["metadata"]["uid"] for pod in on.get("pods", "--selector=part=manager")["items"]]
    if len(found) > 1:
        raise Lost("two managers at once")
    return found


CASES: tuple[Callable[[Cluster], dict[str, int]], ...] = (held, refused, placed, replaced, renewed, rolled)


def main() -> int:
    """Run the cases; return 1 if the server answers otherwise."""
    parser = make_parser(__doc__)
    parser.add_argument("--programs", type=Path, help="folder of the programs")
    args = parser.parse_args()
    path = None if args.programs is None else str(args.programs)
    found = {name: shutil.which(name, path=path) for name in (*PROGRAMS, "openssl")}
    found["openssl"] = shutil.which("openssl")
    if absent := [name for name, program in found.items() if program is None]:
        print(f"not here: no {', '.join(absent)}", file=sys.stderr)
        return exit_codes.BAD_INPUT
    programs = {name: str(Path(program).resolve()) for name, program in found.items() if program}
    counts: dict[str, int] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kubernetes-")))
        on = stack.enter_context(cluster(programs, folder))
        version = json.loads(on.ask("get", "--raw=/version")[1])["gitVersion"]
        for case in CASES:
            try:
                answer = case(on)
            except Lost as error:
                print(f"{case.__name__}: {error}", flush=True)
                return 1
            counts |= answer
            print(f"{case.__name__}: {json.dumps(answer)}", flush=True)
    if args.out is not None:
        write({"commit": args.commit or commit(), "kubernetes": version, **counts}, args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
