/* Reading of links. */
#ifndef IGTL_GATEWAY_PASSAGE_READING_H
#define IGTL_GATEWAY_PASSAGE_READING_H

#include <sys/socket.h>

#include "_large_to_ros.h"

#define LARGEST_RECEIPT (1024 * 1024) /* of a turn */
#define MAX_LARGE_WAITING 3 /* messages; then TCP makes the peer wait */
#define MOST_LARGE_BYTES (256LL << 20) /* of all links; then a link waits behind its first one */
#define PAUSE_NS 1000000 /* the shortest pause of a link that sends more than it may */
#define NOTED_EVERY_NS NS_PER_S /* pauses are reported to Python */
#define QUANTUM_NS 100000 /* a turn of a link ends after the message with which it has lasted this long */

/* A large message that was read whole has passed; the caller has `reading`. */
static int end_body(Link *self)
{
    self->body = NULL;
    self->received_messages++;
    self->room--;
    return 1;
}

/* Pass on a large message that was read whole, if it takes no longer than others may wait; the caller has `reading`. */
static int pass_body(Link *self)
{
    wait_for_sequence(self->passage);
    Stream *stream = __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE) ? NULL : stream_of(self, self->body, self->body_size); /* perhaps for one of its stream */
    int passed = stream && pass_to_ros(self->passage, stream, self->body, self->body_size, self->heard_ns);
    unlock_sequence(self->passage);
    if (!passed)
        return 0;
    free(self->body);
    return end_body(self);
}

static int is_right(const Link *self) { return self->checks && self->body_crc == get_u64(self->body + CRC_AT); }

/* Pass on a message that is larger than its outputs, such as points, without the way to the other thread.  What is
 * recorded is copied whole: others would wait for that.  The caller has `reading`. */
static int pass_points(Link *self)
{
    Passage *passage = self->passage;
    struct rcl_serialized message = {.buffer = self->body, .length = (size_t)self->body_size};
    wait_for_sequence(passage);
    int waits = passage->is_recorded || __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE);
    Stream *stream = waits ? NULL : stream_of(self, self->body, self->body_size);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 1, __ATOMIC_RELEASE);
    unlock_sequence(passage);
    struct kept *kept = stream ? keep(&message) : NULL;
    int passed = kept && pass_large_to_ros(self, stream, kept, is_right(self), LARGEST_RECEIVED);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 0, __ATOMIC_RELEASE);
    if (!passed) {
        give_back(kept);
        return 0;
    }
    leave_kept(kept);
    return end_body(self);
}

/* Leave a large message that was read whole to Python, and go on reading; the caller has `reading`. */
static void end_large(Link *self)
{
    struct large *large = calloc(1, sizeof *large);
    Passage *passage = self->passage;
    if (!large) { /* Python reads it from the beginning */
        give_to_python(self, 0);
        return;
    }
    large->message.buffer = self->body;
    large->message.length = large->message.capacity = (size_t)self->body_size;
    large->is_checked = (char)is_right(self);
    end_body(self);
    pthread_mutex_lock(&passage->events);
    *self->large_end = large;
    self->large_end = &large->next;
    passage->large_bytes += (long long)large->message.length;
    int is_much = passage->large_bytes > MOST_LARGE_BYTES;
    int waiting = __atomic_add_fetch(&self->large_waiting, 1, __ATOMIC_SEQ_CST);
    if (!self->is_with_large) {
        self->is_with_large = 1;
        self->next_with_large = passage->with_large;
        passage->with_large = self;
        pthread_cond_signal(&passage->large_read);
    }
    pthread_mutex_unlock(&passage->events);
    if (waiting >= (is_much ? 1 : MAX_LARGE_WAITING)) {
        epoll_ctl(passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
        __atomic_store_n(&self->is_paused, 1, __ATOMIC_SEQ_CST);
    }
}

/* Begin to read a large message, whose beginning is in the chunk; 0: Python has to read it.  ``body``: as its header has it,
 * so the sum with that of the header may wrap around. */
static int begin_large(Link *self, uint64_t body)
{
    const uint8_t *names = self->chunk + self->start;
    wait_for_sequence(self->passage);
    ssize_t most = most_of_large(self, names);
    ssize_t total = most > HEADER_SIZE && body <= (uint64_t)(most - HEADER_SIZE) ? HEADER_SIZE + (ssize_t)body : 0;
    Stream *stream = total > LARGEST_RECEIVED ? stream_named(self->streams[bucket_of(names)], names) : NULL;
    self->checks = stream && stream->is_bulk && stream->bulk_from_igtl.check_crc;
    unlock_sequence(self->passage);
    if (!total || !(self->body = malloc((size_t)total)))
        return 0;
    self->body_size = total;
    self->body_filled = self->filled - self->start;
    memcpy(self->body, names, (size_t)self->body_filled);
    self->body_crc = self->checks ? crc64_update(0, self->body + HEADER_SIZE, self->body_filled - HEADER_SIZE) : 0;
    self->start = self->filled = 0;
    return 1;
}

/* Whether what was received is a whole small message, or the beginning of a large one: something to be passed on. */
static int has_message(const Link *self)
{
    ssize_t left = self->filled - self->start;
    if (left < HEADER_SIZE)
        return 0;
    uint64_t body = get_u64(self->chunk + self->start + BODY_SIZE_AT);
    return body > CHUNK_BYTES - HEADER_SIZE || left >= HEADER_SIZE + (ssize_t)body;
}

/* Let the room grow until now. */
static void make_room(Link *self, int64_t now_ns)
{
    self->room += (double)(now_ns - self->rated_ns) * self->rate / NS_PER_S;
    if (self->room > self->rate)
        self->room = self->rate;
    self->rated_ns = now_ns;
}

/* Receive once; 0: there is nothing to be passed on.  The caller has `reading`. */
static int receive(Link *self)
{
    if (self->start) {
        self->filled -= self->start;
        memmove(self->chunk, self->chunk + self->start, (size_t)self->filled);
        self->start = 0;
    }
    uint8_t *place = self->body ? self->body + self->body_filled : self->chunk + self->filled;
    ssize_t room = self->body ? self->body_size - self->body_filled : CHUNK_BYTES - self->filled;
    ssize_t count = recv(self->fd, place, (size_t)(room < LARGEST_RECEIPT ? room : LARGEST_RECEIPT), MSG_DONTWAIT);
    if (count < 0 && (errno == EAGAIN || errno == EINTR))
        return 0;
    if (count <= 0) {
        give_to_python(self, count ? errno : 0);
        return 0;
    }
    self->heard_ns = clock_ns(CLOCK_MONOTONIC);
    self->received_bytes += count;
    make_room(self, self->heard_ns);
    if (!self->body) {
        self->filled += count;
        return has_message(self);
    }
    self->body_filled += count;
    if (self->checks)
        self->body_crc = crc64_update(self->body_crc, place, count);
    int is_whole = self->body_filled == self->body_size;
    if (is_whole && !(self->body_size > LARGEST_RECEIVED ? pass_points(self) : pass_body(self)))
        end_large(self);
    return 0;
}

/* Read on when there is room again: what the peer sends waits in its connection.  The caller has `reading`. */
static void limit_rate(Link *self, int64_t now_ns)
{
    Passage *passage = self->passage;
    int64_t pause_ns = self->rate > 0 ? (int64_t)((1 - self->room) / self->rate * NS_PER_S) : NS_PER_S;
    self->pause_ends_ns = now_ns + (pause_ns > PAUSE_NS ? pause_ns : PAUSE_NS);
    self->is_limited = 1;
    epoll_ctl(passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
    if (!self->is_listed) {
        self->is_listed = 1;
        self->next_limited = passage->limited;
        passage->limited = self;
    }
    add(&self->pauses);
    if (!self->pauses_noted_ns || now_ns - self->pauses_noted_ns >= NOTED_EVERY_NS) {
        self->pauses_noted_ns = now_ns;
        note_link(self);
    }
}

/* Take a turn: pass on what is whole, or receive once before; whether more is left for the next turn.  ``is_inside``: whether
 * a large message is being read. */
static int read_link(Link *self, int64_t begun_ns, int *is_inside)
{
    Passage *passage = self->passage;
    int64_t now_ns = begun_ns;
    int left = 0;
    pthread_mutex_lock(&self->reading);
    if (self->reader != NATIVE || self->is_paused || self->is_limited)
        goto done;
    make_room(self, begun_ns);
    left = has_message(self) || receive(self);
    while (left && now_ns - begun_ns < QUANTUM_NS) {
        if (self->room < 1) {
            limit_rate(self, now_ns);
            left = 0;
            break;
        }
        const uint8_t *message = self->chunk + self->start;
        uint64_t body = get_u64(message + BODY_SIZE_AT);
        int passed = 0;
        if (body <= CHUNK_BYTES - HEADER_SIZE) {
            wait_for_sequence(passage);
            Stream *stream = stream_of(self, message, HEADER_SIZE + (ssize_t)body);
            int waits = __atomic_load_n(&self->large_waiting, __ATOMIC_ACQUIRE) && most_of_large(self, message); /* for one of its stream */
            passed = stream && !waits && pass_to_ros(passage, stream, message, HEADER_SIZE + (ssize_t)body, now_ns);
            unlock_sequence(passage);
        } else if (begin_large(self, body)) {
            left = 0;
            break;
        }
        if (!passed) {
            give_to_python(self, 0);
            left = 0;
            break;
        }
        self->received_messages++;
        self->room--;
        self->start += HEADER_SIZE + (ssize_t)body;
        left = has_message(self);
        now_ns = clock_ns(CLOCK_MONOTONIC);
    }
done:
    *is_inside = self->body != NULL;
    __atomic_store_n(&self->pending, self->body ? self->body_filled : self->filled - self->start, __ATOMIC_RELAXED);
    pthread_mutex_unlock(&self->reading);
    return left;
}

#endif
