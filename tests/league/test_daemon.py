"""The manager alone: what it plans, without the worker processes that would do it."""

from league.config import experiment as configuration
from league.config import presets
from league.create import create
from league.daemon import Manager
from storage.errors import Away
from storage.store import Store


def test_a_plan_for_which_the_store_was_away_is_made_again(duel, tmp_path, capsys):
    config = presets.duel()
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, duel)
        manager = Manager(store, str(tmp_path / "store"), configuration.loads(configuration.dumps(config)))
        manager._slots.clear()
        queue, lost = store.queue, []

        def lose_one(*args):
            if not lost:
                lost.append(args)
                raise Away("the store: another process kept it locked for 60 s")
            return queue(*args)

        store.queue = lose_one
        told = []

        def tell(standing, *_):
            told.append([job.kind for job in standing.jobs])
            if told[-1] or len(told) > 3:
                store.ask_stop(config.league)

        assert manager.run(tell) == "stopped"
        assert lost
        assert "train" in told[-1]
        assert "waiting: the store: another process" in capsys.readouterr().err
        assert store.leader(config.league) is None
