/* Taking of messages from subscriptions. */
#ifndef IGTL_GATEWAY_PASSAGE_TAKING_H
#define IGTL_GATEWAY_PASSAGE_TAKING_H

#include "_large_to_igtl.h"
#include "_to_igtl.h"

#define BATCH_NS 3000000 /* messages of ROS that wait pass with one taking of the sequence lock, for this time at most */

/* Pass on a message that was taken; 0: it is Python's.  The caller has the sequence lock. */
static int pass_taken(Subscription *self, int64_t begun_ns)
{
    if (!self->stream || !pass_to_igtl(self->passage, self->stream, self->message.buffer,
                                       (ssize_t)self->message.length, self->info.source_ns, begun_ns))
        return 0;
    self->last_size = self->message.length;
    count_received(self);
    return 1;
}

/* Pass on what is held and what is there, until nothing is left, which is RCL_RET_SUBSCRIPTION_TAKE_FAILED.
 * Or return another code: RCL_RET_OK where a message is held for Python, where the sequence lock was not to be had, and
 * after a large one: others have their turn.
 *
 * Several messages pass with one taking of the lock: where many want it, who takes it for each message waits each time.
 * Only the taker of a subscription takes from it, so a thread that waits for the lock has no lock of the middleware that
 * this one needs. */
static int pass_all(Subscription *self, int is_of_middleware)
{
    Passage *passage = self->passage;
    for (;;) {
        int code = RCL_RET_OK;
        if (self->holds == EMPTY) {
            if ((code = passage->take(self->pointer, &self->message, &self->info, NULL)) != RCL_RET_OK)
                return code;
            move_holds(self, HELD);
        }
        int64_t now_ns = clock_ns(CLOCK_MONOTONIC);
        if (self->message.length > LARGEST_INPUT || !__atomic_load_n(&self->stream, __ATOMIC_RELAXED)) {
            if (!is_of_middleware && self->holds == HELD && !pass_held(self))
                move_holds(self, REFUSED);
            return RCL_RET_OK;
        }
        if (!is_of_middleware)
            wait_for_sequence(passage);
        else if (!lock_sequence(passage))
            return RCL_RET_OK;
        int64_t until_ns = clock_ns(CLOCK_MONOTONIC) + BATCH_NS; /* the time that it waited does not count */
        while (self->message.length <= LARGEST_INPUT && pass_taken(self, now_ns)) {
            move_holds(self, EMPTY);
            now_ns = clock_ns(CLOCK_MONOTONIC);
            if (now_ns >= until_ns ||
                (code = passage->take(self->pointer, &self->message, &self->info, NULL)) != RCL_RET_OK)
                break;
            move_holds(self, HELD);
        }
        unlock_sequence(passage);
        if (self->holds != EMPTY || code != RCL_RET_OK)
            return code;
    }
}

/* Pass on what waits, in a thread without locks of the middleware that has taken over; the last code of pass_all. */
static int pass_waiting(Subscription *self)
{
    for (;;) {
        pthread_mutex_lock(&self->state);
        self->is_pending = 0;
        pthread_mutex_unlock(&self->state);
        int code = pass_all(self, 0);
        if (code != RCL_RET_SUBSCRIPTION_TAKE_FAILED)
            return code;
        pthread_mutex_lock(&self->state);
        int idle = !self->is_pending;
        if (idle)
            move_taker(self, IDLE);
        pthread_mutex_unlock(&self->state);
        if (idle)
            return code;
    }
}

/* A thread of the middleware has a message for the subscription: take it here if its stream is compiled. */
static void on_message(const void *user_data, size_t events)
{
    Subscription *self = (Subscription *)user_data;
    Passage *passage = self->passage;
    (void)events;
    pthread_mutex_lock(&self->state);
    self->is_pending = 1;
    if (atomic_load_explicit(&self->taker, memory_order_relaxed) != IDLE) {
        pthread_mutex_unlock(&self->state);
        return;
    }
    /* A thread that publishes with the sequence lock may be called for a subscription of its own node. */
    int passes = !has_sequence(passage) && __atomic_load_n(&self->stream, __ATOMIC_RELAXED) &&
                 self->last_size <= LARGEST_INPUT; /* the next one is as large as the last */
    move_taker(self, passes ? TAKING : WAITS);
    pthread_mutex_unlock(&self->state);
    while (passes) {
        pthread_mutex_lock(&self->state);
        self->is_pending = 0;
        pthread_mutex_unlock(&self->state);
        int code = pass_all(self, 1);
        pthread_mutex_lock(&self->state);
        if (code != RCL_RET_SUBSCRIPTION_TAKE_FAILED) {
            self->failure = code == RCL_RET_OK ? 0 : code;
            passes = 0;
        } else if (!self->is_pending) {
            move_taker(self, IDLE);
            pthread_mutex_unlock(&self->state);
            return;
        }
        if (!passes)
            move_taker(self, WAITS);
        pthread_mutex_unlock(&self->state);
    }
    note_subscription(self);
}

#endif
