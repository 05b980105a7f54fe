/* The guard of a stream, as far as the passage judges. */
#ifndef IGTL_GATEWAY_PASSAGE_GUARD_H
#define IGTL_GATEWAY_PASSAGE_GUARD_H

#include "_lock.h"

#define OBSERVATIONS 256

/* As in guarded_stream.py and timing.py. */
#define LOOK_NS (100 * 1000000LL)
#define FUTURE_NS (100 * 1000000LL)
#define STILL_LOOKS 20
#define LEAST_SUSPECT 100.0 /* a factor between two translations from which on Python judges */

/* The state of igtl_gateway.gateway.guarded_stream.GuardedStream that a message needs. */
typedef struct {
    PyObject_HEAD
    char is_dirty;                  /* messages have changed it since the last collection */
    char watches, judged_by_python; /* the latter: a stale stream */
    char has_place, knows_age;
    int64_t max_age_ns, ahead_ns, last_ns, look_ns, due_ns, seen_ns, arrived_ns;
    int64_t episode_ends_ns; /* after it, Python ends an episode of an oddity, whose other messages pass */
    int64_t still;
    double place[3];
    int observed; /* stamp (0: unset) and time of arrival of the looks that Python has not added to its timing */
    int64_t observations[OBSERVATIONS][2];
} Guard;

/* is_unit_jump of guarded_stream.py, without its precision: 1 where Python has to judge. */
static int might_jump(const double before[3], const double after[3])
{
    double one = before[0] * before[0] + before[1] * before[1] + before[2] * before[2];
    double other = after[0] * after[0] + after[1] * after[1] + after[2] * after[2];
    double least = one < other ? one : other, most = one < other ? other : one;
    return !(most <= LEAST_SUSPECT * LEAST_SUSPECT * least) && most > 0.0;
}

/* GuardedStream.passes_quickly: 1 where the message passes and is observed; 0, and nothing changes: Python judges.
 * A twin of guarded_stream.py, see ARCHITECTURE.md; tests/native/test_twins.py compares them. */
static int passes_guard(Guard *guard, int64_t now_ns, int64_t stamp_ns, const double place[3])
{
    if (!guard)
        return 1;
    if (guard->judged_by_python)
        return 0;
    if (stamp_ns < guard->last_ns)
        return 0;
    if (now_ns >= guard->look_ns) {
        if (guard->max_age_ns && ((stamp_ns == now_ns && !guard->knows_age) ||
                                  now_ns - guard->ahead_ns - stamp_ns > guard->max_age_ns))
            return 0;
        if (guard->watches && now_ns >= guard->due_ns) {
            int64_t still = stamp_ns == guard->seen_ns ? guard->still + 1 : 0;
            if (stamp_ns != now_ns && stamp_ns - now_ns + guard->ahead_ns > FUTURE_NS)
                return 0;
            if (still >= STILL_LOOKS || guard->observed == OBSERVATIONS || now_ns > guard->episode_ends_ns)
                return 0;
            if (place && guard->has_place && might_jump(guard->place, place))
                return 0;
            int64_t *observation = guard->observations[guard->observed++];
            observation[0] = stamp_ns != now_ns ? stamp_ns : 0;
            observation[1] = now_ns - guard->ahead_ns;
            guard->still = still;
            guard->seen_ns = stamp_ns;
            guard->has_place = place != NULL;
            if (place)
                memcpy(guard->place, place, sizeof guard->place);
            guard->arrived_ns = now_ns;
            guard->due_ns = now_ns + LOOK_NS;
            guard->look_ns = guard->max_age_ns ? 0 : guard->due_ns;
        }
    }
    guard->last_ns = stamp_ns;
    guard->is_dirty = 1;
    return 1;
}

#endif
