# SPDX-License-Identifier: Apache-2.0
import pytest

from rlml_slam.errors import InputError
from rlml_slam.motion import SECOND
from rlml_slam.sensing.synchronization.input_counts import InputCounts
from rlml_slam.sensing.synchronization.stamp_check import CONFIRM, LASTING, PERSISTENT, StampCheck
from rlml_slam.types import Imu

T0 = 10 * SECOND
STEP = SECOND // 50


def running(count=20):
    """A check that has accepted ``count`` stamps of odometry."""
    stamps = StampCheck(InputCounts())
    for k in range(count):
        assert stamps.accept('odom', T0 + k * STEP, stamps.newest_of('odom'))
    return stamps, T0 + (count - 1) * STEP


def test_newest_stamp_of_all_streams_and_of_each():
    stamps, newest = running()
    assert stamps.accept('imu', newest - STEP, None)
    assert (stamps.newest, stamps.newest_of('imu')) == (newest, newest - STEP)
    assert stamps.newest_of('scan') is None
    assert stamps.first == T0


def test_stamp_that_is_not_after_the_limit_is_late():
    stamps, newest = running()
    assert not stamps.accept('odom', newest, newest)
    assert stamps._inputs.totals() == {'odom': {'late': 1}}


def test_newest_stamp_of_a_source_is_a_duplicate():
    stamps, newest = running()
    assert stamps.accept('scan', newest, None, 'front')
    assert stamps.is_duplicate('scan', newest, 'front')
    assert not stamps.is_duplicate('scan', newest, 'rear')


def test_message_far_ahead_is_held_and_rejected_if_the_others_go_on():
    stamps, newest = running()
    assert stamps.holds('imu', Imu(newest + 100 * SECOND, 0.0))
    assert list(stamps.release_held(CONFIRM)) == []
    for k in range(CONFIRM):
        message = Imu(newest + (k + 1) * STEP, 0.0)
        assert not stamps.holds('odom', message)
        assert stamps.accept('odom', message.stamp, stamps.newest_of('odom'))
    assert list(stamps.release_held(CONFIRM)) == []
    assert not stamps.has_held
    assert stamps._inputs.totals() == {'imu': {'future': 1}}


def test_messages_far_ahead_are_accepted_if_more_follow():
    stamps, newest = running()
    ahead = [Imu(newest + 100 * SECOND + k * STEP, 0.0) for k in range(CONFIRM)]
    assert all(stamps.holds('imu', message) for message in ahead)
    assert [m for _, m in stamps.release_held(CONFIRM)] == ahead
    assert not stamps.holds('imu', Imu(ahead[-1].stamp + STEP, 0.0))


def test_stamps_that_stay_behind_show_that_the_newest_was_wrong():
    stamps, newest = running()
    assert stamps.accept('imu', newest + 60 * SECOND, None)
    found = [stamps.wrong_after('odom', newest + k, None) for k in range(PERSISTENT)]
    assert found[:-1] == [None] * (PERSISTENT - 1)
    stamps.forget_after(found[-1])
    assert stamps.newest == newest
    assert stamps._inputs.totals() == {'imu': {'future': 1}}


def test_clock_that_was_set_back_is_an_error():
    stamps, newest = running()
    start, lasts = newest - 10 * SECOND, LASTING // STEP
    assert lasts > PERSISTENT
    for k in range(lasts):
        assert stamps.wrong_after('odom', start + k * STEP, newest) is None
    with pytest.raises(InputError, match=r'the clock of odom jumped back by 9\.0 s'):
        stamps.wrong_after('odom', start + lasts * STEP, newest)


def test_burst_of_old_messages_is_no_clock_that_was_set_back():
    """Of a second publisher, say, that had no processor for two seconds."""
    stamps, newest = running()
    for k in range(900):
        assert stamps.wrong_after('odom', newest - 2 * SECOND + k * 10**6, newest) is None
    for k in range(1, 100):
        assert stamps.wrong_after('odom', newest + k * STEP, newest + (k - 1) * STEP) is None
        assert stamps.accept('odom', newest + k * STEP, stamps.newest_of('odom'))
        late = newest - 2 * SECOND + k * STEP
        assert stamps.wrong_after('odom', late, newest + k * STEP) is None


def old_messages(newest):
    return [newest - 9 * SECOND + k * STEP for k in range(4 * LASTING // STEP)]


def arrive(stamps, newest, *others):
    """Old messages arrive at the pace of their stamps, each one together with others."""
    for k, stamp in enumerate(old_messages(newest)):
        stamps.expect([stamp, *others], k * STEP / SECOND)
        assert stamps.wrong_after('odom', stamp, newest) is None


def test_old_messages_that_arrived_with_others_on_time_are_no_clock_that_was_set_back():
    stamps, newest = running()
    arrive(stamps, newest, newest + STEP)


def test_random_stamps_beside_a_clock_that_was_set_back_are_not_on_time():
    stamps, newest = running()
    with pytest.raises(InputError, match='jumped back'):
        arrive(stamps, newest, newest + 60 * SECOND, 2**62, 0)


@pytest.mark.parametrize('pace', [1.0, 20.0])
def test_old_messages_that_arrive_all_at_once_are_no_clock_that_was_set_back(pace):
    stamps = StampCheck(InputCounts())
    for k in range(1000):
        stamps.expect([T0 + k * STEP], k * STEP / SECOND / pace)
        assert stamps.accept('odom', T0 + k * STEP, stamps.newest_of('odom'))
    newest, now = stamps.newest, 999 * STEP / SECOND / pace
    for k, stamp in enumerate(old_messages(newest)):
        stamps.expect([stamp], now + 0.01 * k * STEP / SECOND / pace)
        assert stamps.wrong_after('odom', stamp, newest) is None
    stamps.expect([newest + STEP], now + 1.0)
    stamps.wrong_after('odom', newest + STEP, newest)

    def set_back():
        for k, stamp in enumerate(old_messages(newest)[:60]):
            stamps.expect([stamp], now + 2.0 + k * STEP / SECOND / pace)
            stamps.wrong_after('odom', stamp, newest)

    with pytest.raises(InputError, match='jumped back'):
        set_back()


def test_one_wrong_stamp_of_a_late_stream_is_no_clock_that_was_set_back():
    """It arrives 2 s behind the others, and one of its messages has a stamp of long ago."""
    stamps, newest = running(200)
    behind = [newest - 2 * SECOND + k * STEP for k in range(2 * PERSISTENT)]
    behind[PERSISTENT - 1] = 1
    for stamp in behind:
        assert stamps.wrong_after('imu', stamp, newest) is None
        stamps.accept('imu', stamp, stamps.newest_of('imu'))


def test_clock_that_was_set_back_is_an_error_beside_a_stream_that_is_always_late():
    """Detections that are refused as late have no accepted stamp to be compared with."""
    stamps, newest = running(200)
    first = [('reflectors', newest - SECOND), ('odom', newest)]
    later = [
        (stream, newest - 10 * SECOND + k * STEP - late)
        for k in range(LASTING // STEP + 1)
        for stream, late in (('odom', 0), ('reflectors', SECOND))
    ]

    def play(messages):
        for stream, stamp in messages:
            stamps.wrong_after(stream, stamp, newest)

    play(first)
    with pytest.raises(InputError, match='jumped back'):
        play(later)


def test_random_stamps_far_ahead_confirm_nothing_while_time_goes_on():
    stamps, newest = running()
    for k in range(4 * CONFIRM):
        assert stamps.holds('imu', Imu(newest + (100 + 37 * (k % 5)) * SECOND, 0.0))
        assert list(stamps.release_held(CONFIRM)) == []
        assert stamps.accept('odom', newest + (k + 1) * STEP, stamps.newest_of('odom'))
    assert stamps._inputs.totals() == {'imu': {'future': 4 * CONFIRM - 1}}


@pytest.mark.parametrize('gaps', [[1.2], [2.0], [2.0, 7.0, 1.5, 20.0]])
def test_stream_that_is_slow_or_irregular_is_accepted(gaps):
    stamps, stamp, accepted = StampCheck(InputCounts()), T0, []
    for k in range(40):
        message = Imu(stamp, 0.0)
        found = [] if stamps.holds('scan', message) else [('scan', message)]
        for stream, one in [*stamps.release_held(CONFIRM), *found]:
            if stamps.accept(stream, one.stamp, stamps.newest_of(stream)):
                accepted.append(one)
        stamp += round(gaps[k % len(gaps)] * SECOND)
    assert len(accepted) >= 40 - CONFIRM


def test_stream_that_is_late_as_a_whole_is_no_clock_that_was_set_back():
    """All of a second and a half at once, after a pause of the network or of its driver."""
    stamps, newest = running()
    assert stamps.accept('imu', newest, None)
    late = newest + STEP
    assert stamps.accept('scan', newest + 3 * SECOND, None)
    for k in range(4 * PERSISTENT):
        assert stamps.wrong_after('imu', late + k * STEP, newest + 3 * SECOND) is None
        assert stamps.accept('imu', late + k * STEP, stamps.newest_of('imu'))
