/* Large messages that have passed, and are copied to the recorder's queue a little later. */
#ifndef IGTL_GATEWAY_PASSAGE_UNFILLED_H
#define IGTL_GATEWAY_PASSAGE_UNFILLED_H

#include <errno.h>

#include "_recording.h"

#define MAX_UNFILLED 3 /* messages of a direction; then the oldest is copied to the recorder at once */
#define READ_BYTES_PER_US 1500 /* by the receiver of a large message: its copies and ours would share the memory's bandwidth */

/* A large message that has passed, and has places in the recorder's queue: it is copied there when its receiver has
 * probably read it. */
struct unfilled {
    struct unfilled *next;
    int direction, count;       /* of the entries: the input and its outputs */
    int64_t passed_ns, due_ns;  /* monotonic */
    uint8_t *slots[1 + MAX_OUTPUTS];
    struct iovec parts[1 + MAX_OUTPUTS][MAX_PARTS];
    int parts_counts[1 + MAX_OUTPUTS];
    struct kept *kept; /* what the parts are of: this and */
    uint8_t *made;
};

static void add_entry(struct unfilled *unfilled, uint8_t *slot, const struct iovec *parts, int count)
{
    memcpy(unfilled->parts[unfilled->count], parts, (size_t)count * sizeof *parts);
    unfilled->parts_counts[unfilled->count] = count;
    unfilled->slots[unfilled->count++] = slot;
}

/* Copy a message to its places in the recorder's queue, if it has any, and forget it. */
static void end_unfilled(Passage *self, struct unfilled *unfilled)
{
    for (int i = 0; i < unfilled->count; i++)
        fill(unfilled->slots[i], unfilled->parts[i], unfilled->parts_counts[i]);
    count_recording(self, unfilled->direction, unfilled->passed_ns);
    attend_recorder(self);
    move_kept(unfilled->kept, FILLED);
    leave_kept(unfilled->kept);
    free(unfilled->made);
    free(unfilled);
}

/* Take the oldest of a direction that has waited until this time (monotonic); NULL: none has.  With the lock of events. */
static struct unfilled *take_unfilled(Passage *self, int direction, int64_t until_ns)
{
    struct unfilled *oldest = self->unfilled[direction];
    if (!oldest || (oldest->due_ns > until_ns && self->unfilled_count[direction] <= MAX_UNFILLED))
        return NULL;
    if (!(self->unfilled[direction] = oldest->next))
        self->unfilled_end[direction] = &self->unfilled[direction];
    self->unfilled_count[direction]--;
    return oldest;
}

/* Copy all of a direction that have waited until this time. */
static void fill_until(Passage *self, int direction, int64_t until_ns)
{
    for (;;) {
        pthread_mutex_lock(&self->events);
        struct unfilled *unfilled = take_unfilled(self, direction, until_ns);
        pthread_mutex_unlock(&self->events);
        if (!unfilled)
            return;
        end_unfilled(self, unfilled);
    }
}

/* Copy a message that has just passed to the recorder's queue, when ``bytes`` of it are read.  Owns ``made`` from here on,
 * and takes part in ``kept``. */
static void fill_later(Passage *self, struct unfilled *unfilled, struct kept *kept, uint8_t *made, ssize_t bytes)
{
    int direction = unfilled->direction;
    unfilled->due_ns = unfilled->passed_ns + (int64_t)bytes * 1000 / READ_BYTES_PER_US;
    unfilled->kept = kept, unfilled->made = made;
    __atomic_add_fetch(&kept->owners, 1, __ATOMIC_RELAXED);
    if (!self->is_recorded) {
        end_unfilled(self, unfilled);
        return;
    }
    pthread_mutex_lock(&self->events);
    move_kept(kept, UNFILLED);
    *self->unfilled_end[direction] = unfilled;
    self->unfilled_end[direction] = &unfilled->next;
    self->unfilled_count[direction]++;
    pthread_mutex_unlock(&self->events);
    fill_until(self, direction, unfilled->passed_ns);
}

/* Wait for a condition, and copy meanwhile what is due.  With the lock of events. */
static void wait_and_fill(Passage *self, pthread_cond_t *condition, int direction)
{
    const struct unfilled *oldest = self->unfilled[direction];
    if (!oldest) {
        pthread_cond_wait(condition, &self->events);
        return;
    }
    int64_t due_ns = oldest->due_ns;
    const struct timespec until = {.tv_sec = due_ns / NS_PER_S, .tv_nsec = due_ns % NS_PER_S};
    if (pthread_cond_timedwait(condition, &self->events, &until) != ETIMEDOUT)
        return;
    pthread_mutex_unlock(&self->events);
    fill_until(self, direction, due_ns);
    pthread_mutex_lock(&self->events);
}

#endif
