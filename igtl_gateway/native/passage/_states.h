/* The states of a large message and of a subscription: STATES.md has who may move them, and under which lock.
 *
 * Compiled with IGTL_GATEWAY_CHECKED, a transition that is not in these tables aborts.
 */
#ifndef IGTL_GATEWAY_PASSAGE_STATES_H
#define IGTL_GATEWAY_PASSAGE_STATES_H

#ifdef IGTL_GATEWAY_CHECKED
#include <stdio.h>
#include <stdlib.h>
#endif

#define TO(state) (1u << (state))

/* Of the memory of a message (struct kept). */
enum kept_state { OWN, STAYS, ADMITTED, LENT, UNFILLED, FILLED, TAKEN, GONE };

static const unsigned KEPT_MOVES[] = {
    [OWN] = TO(STAYS) | TO(GONE) | TO(ADMITTED),
    [STAYS] = TO(OWN) | TO(ADMITTED),
    [ADMITTED] = TO(LENT) | TO(UNFILLED) | TO(FILLED),
    [LENT] = TO(ADMITTED),
    [UNFILLED] = TO(FILLED),
    [FILLED] = TO(TAKEN) | TO(GONE),
    [TAKEN] = TO(GONE),
    [GONE] = 0,
};

/* Who takes from a subscription: no thread, one of the middleware, the one of subscriptions (soon, or now), or Python. */
enum taker { IDLE, TAKING, WAITS, PASSING, WITH_PYTHON };

static const unsigned TAKER_MOVES[] = {
    [IDLE] = TO(TAKING) | TO(WAITS),
    [TAKING] = TO(IDLE) | TO(WAITS),
    [WAITS] = TO(PASSING),
    [PASSING] = TO(IDLE) | TO(WAITS) | TO(WITH_PYTHON),
    [WITH_PYTHON] = TO(PASSING) | TO(WAITS) | TO(IDLE),
};

/* What a taker holds: nothing, a message that was taken and has not passed, or one that is large, and for Python. */
enum holds { EMPTY, HELD, REFUSED };

static const unsigned HOLDS_MOVES[] = {
    [EMPTY] = TO(HELD),
    [HELD] = TO(EMPTY) | TO(REFUSED),
    [REFUSED] = TO(EMPTY),
};

/* Return the state to move to from another one; ``moves``: the table of ``what``. */
static inline int moved(const char *what, const unsigned *moves, int from, int to)
{
#ifdef IGTL_GATEWAY_CHECKED
    if (!(moves[from] & TO(to))) {
        fprintf(stderr, "igtl_gateway: %s moves from state %d to %d, which is not in STATES.md\n", what, from, to);
        abort();
    }
#else
    (void)what, (void)moves, (void)from;
#endif
    return to;
}

#endif
