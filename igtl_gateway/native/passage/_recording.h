/* The recorder's queue, as the passage writes to it. */
#ifndef IGTL_GATEWAY_PASSAGE_RECORDING_H
#define IGTL_GATEWAY_PASSAGE_RECORDING_H

#include <sys/uio.h>

#include "_streams.h"

#define ROOM_AHEAD (2 * 1024 * 1024) /* that small messages should have in the recorder's queue before Python finds more */

/* Bytes that the next messages might need in the recorder's queue. */
static ssize_t room_ahead(const Passage *self)
{
    return ROOM_AHEAD + __atomic_load_n(&self->largest_recorded, __ATOMIC_RELAXED);
}

/* Have Python wake the recorder, or find room for the next messages, after one with which that is due. */
static void attend_recorder(Passage *self)
{
    if (!__atomic_exchange_n(&self->presses, 0, __ATOMIC_RELAXED))
        return;
    pthread_mutex_lock(&self->events);
    self->attends = 1;
    pthread_cond_signal(&self->pressed);
    pthread_mutex_unlock(&self->events);
}

/* Take the recorder's queue for entries of these streams; 0: Python has to put them. ``most``: bytes. */
static int begin_record(Passage *self, Stream *stream, struct output *const *outputs, int count, ssize_t bytes,
                        ssize_t most)
{
    if (!self->is_recorded)
        return 1;
    if (!lock_briefly(&self->queue_lock->mutex))
        return 0;
    int known = queue_knows(&self->queue, stream->number);
    for (int i = 0; i < count; i++)
        known &= queue_knows(&self->queue, outputs[i]->number);
    stream->is_stale |= !known;
    if (known && bytes <= most && queue_has_room(&self->queue, (uint64_t)count + 1, (uint64_t)bytes)) {
        if (bytes > self->largest_recorded)
            __atomic_store_n(&self->largest_recorded, bytes, __ATOMIC_RELAXED);
        if (queue_presses(&self->queue, (uint64_t)count + 1, (uint64_t)bytes) ||
            queue_left(&self->queue) < (uint64_t)(bytes + room_ahead(self)))
            __atomic_store_n(&self->presses, 1, __ATOMIC_RELAXED);
        return 1;
    }
    pthread_mutex_unlock(&self->queue_lock->mutex);
    return 0;
}

static void end_record(Passage *self)
{
    if (self->is_recorded)
        pthread_mutex_unlock(&self->queue_lock->mutex);
}

/* Give an input and its outputs, which are in the scratch memory, to the recorder; then its queue is free. */
static void record(Passage *self, const Stream *stream, struct output *const *outputs, const ssize_t *sizes, int count,
                   uint64_t seq, int64_t stamp_ns, int64_t source_ns, int64_t shown_ns, const uint8_t *data, ssize_t size)
{
    if (!self->is_recorded)
        return;
    queue_add(&self->queue, stream->number, seq, (uint64_t)stamp_ns, (uint64_t)source_ns, data, (uint64_t)size);
    for (int i = 0; i < count; i++)
        queue_add(&self->queue, outputs[i]->number, seq + 1 + (uint64_t)i, (uint64_t)(stamp_ns + 1 + i), (uint64_t)shown_ns,
                  scratch_of(self, i), (uint64_t)sizes[i]);
    end_record(self);
}

/* Have places for the payloads of an input and its outputs in the recorder's queue, which is free then: they are to be
 * filled at once, without the locks. */
static void reserve(Passage *self, const Stream *stream, struct output *const *outputs, const ssize_t *sizes, int count,
                    uint64_t seq, int64_t stamp_ns, int64_t source_ns, int64_t shown_ns, ssize_t size, uint8_t **slots)
{
    if (!self->is_recorded)
        return;
    slots[0] = queue_reserve(&self->queue, stream->number, seq, (uint64_t)stamp_ns, (uint64_t)source_ns, (uint64_t)size);
    for (int i = 0; i < count; i++)
        slots[1 + i] = queue_reserve(&self->queue, outputs[i]->number, seq + 1 + (uint64_t)i, (uint64_t)(stamp_ns + 1 + i),
                                     (uint64_t)shown_ns, (uint64_t)sizes[i]);
    end_record(self);
}

/* Copy the parts, one after the other, to ``to``. */
static void join_parts(uint8_t *to, const struct iovec *parts, int count)
{
    for (int i = 0; i < count; to += parts[i++].iov_len)
        memcpy(to, parts[i].iov_base, parts[i].iov_len);
}

/* Fill a place in the recorder's queue, if there is one. */
static void fill(uint8_t *slot, const struct iovec *parts, int count)
{
    if (!slot)
        return;
    join_parts(slot, parts, count);
    queue_filled(slot);
}

#endif
