/* Sending to links. */
#ifndef IGTL_GATEWAY_PASSAGE_SENDING_H
#define IGTL_GATEWAY_PASSAGE_SENDING_H

#include <poll.h>
#include <sys/socket.h>

#include "_links.h"
#include "_recording.h"

#define ROOM_NS 3000000 /* the longest wait for a peer that is about to take the rest of a large message */

static void unlock_links(Stream *stream, int outputs, int links)
{
    for (int i = 0; i <= outputs && i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        for (int k = 0; k < (i < outputs ? output->link_count : links); k++)
            pthread_mutex_unlock(&output->links[k]->sending->mutex);
    }
}

/* Lock all links of a stream for sending; 0: one of them takes nothing now.  No link is in two outputs. */
static int lock_links(Stream *stream)
{
    for (int i = 0; i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        for (int k = 0; k < output->link_count; k++) {
            Link *link = output->links[k];
            if (!lock_briefly(&link->sending->mutex)) {
                unlock_links(stream, i, k);
                return 0;
            }
            if (!link->muted && link->unsent_bytes - link->lent_bytes > MOST_UNSENT) {
                unlock_links(stream, i, k + 1);
                return 0;
            }
        }
    }
    return 1;
}

/* The lent message is sent, or copied. */
static void end_lending(Link *self)
{
    move_kept(self->lent->kept, ADMITTED);
    self->lent = NULL, self->lent_bytes = 0;
}

/* Free the oldest message that was not sent. */
static void forget_unsent(Link *self)
{
    struct unsent *unsent = self->unsent;
    if (!(self->unsent = unsent->next))
        self->unsent_end = &self->unsent;
    self->unsent_bytes -= unsent->size;
    if (unsent == self->lent)
        end_lending(self);
    free(unsent->data);
    free(unsent->channel);
    if (unsent->is_spare)
        unsent->is_spare = 0;
    else
        free(unsent);
}

/* Have the kernel take as much of a message as it has room for, behind the first ``sent`` bytes; return how much, or -1. */
static ssize_t send_behind(const Link *self, const struct iovec *parts, int count, ssize_t sent)
{
    struct iovec left[MAX_PARTS];
    int number = 0;
    for (int i = 0; i < count; i++) {
        ssize_t size = (ssize_t)parts[i].iov_len, skipped = sent < size ? sent : size;
        sent -= skipped;
        if (skipped < size)
            left[number++] = (struct iovec){(uint8_t *)parts[i].iov_base + skipped, (size_t)(size - skipped)};
    }
    const struct msghdr message = {.msg_iov = left, .msg_iovlen = (size_t)number};
    return sendmsg(self->fd, &message, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Write the head of a frame with a whole message of this size (RFC 6455, section 5.2); return how long it is. */
static ssize_t frame_head(uint8_t *head, ssize_t size)
{
    uint8_t word[8];
    put_u64(word, (uint64_t)size);
    int bytes = size < 126 ? 1 : size < 1 << 16 ? 2 : 8, at = bytes > 1 ? 2 : 1;
    head[0] = 0x82; /* final, binary */
    head[1] = bytes == 2 ? 126 : 127;
    memcpy(head + at, word + 8 - bytes, (size_t)bytes);
    return at + bytes;
}

/* Have the kernel take as much of a message, in its frame, as it has room for; return how much, or -1. */
static ssize_t send_framed(const Link *self, const struct iovec *parts, int count, const uint8_t *head, ssize_t head_size)
{
    struct iovec framed[1 + MAX_PARTS] = {{(void *)head, (size_t)head_size}};
    memcpy(framed + 1, parts, (size_t)count * sizeof *parts);
    const struct msghdr message = {.msg_iov = framed, .msg_iovlen = (size_t)count + 1};
    return sendmsg(self->fd, &message, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Send a message, of which the kernel takes at once what it has room for.  Returns what is queued of the rest, with a copy of
 * it unless ``kept``, which has its memory, is lent; NULL: nothing.  A link that takes nothing any more, because its peer has left, is passed over.
 * The caller has the lock of the link. */
static struct unsent *send_or_queue(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output,
                                    struct kept *kept)
{
    if (self->muted) {
        add(&output->ignored);
        return NULL;
    }
    uint8_t head[10];
    ssize_t head_size = self->is_framed ? frame_head(head, size) : 0;
    ssize_t sent = !self->clear      ? 0
                   : self->is_framed ? send_framed(self, parts, count, head, head_size)
                   : count > 1       ? send_behind(self, parts, count, 0)
                                     : send(self->fd, parts->iov_base, (size_t)size, MSG_DONTWAIT | MSG_NOSIGNAL);
    if (sent == size + head_size) {
        self->sent_messages++;
        self->sent_bytes += size;
        return NULL;
    }
    struct unsent *unsent = calloc(1, sizeof *unsent);
    const int is_spare = !unsent && !self->spare.is_spare;
    if (is_spare)
        unsent = &self->spare;
    if (!unsent) { /* nothing of it is sent: another one waits */
        add(&output->ignored);
        return NULL;
    }
    int lends = kept && self->clear && sent > 0 && !is_spare && !self->is_framed;
    uint8_t *data = lends || is_spare ? NULL : malloc((size_t)size);
    self->clear = 0;
    if (data)
        join_parts(data, parts, count);
    *unsent = (struct unsent){.data = data, .parts = lends ? parts : NULL, .parts_count = count, .size = size,
                              .sent = sent > 0 ? sent : 0, .channel = strdup(output->channel), .keep = output->keep,
                              .is_spare = (char)is_spare};
    *self->unsent_end = unsent;
    self->unsent_end = &unsent->next;
    self->unsent_bytes += size;
    if (lends) {
        move_kept(kept, LENT);
        unsent->kept = kept;
        self->lent = unsent, self->lent_bytes = size;
    }
    return unsent;
}

/* Send a message; what the kernel does not take is Python's, so that a link that is read slowly leaves the others native.
 * The caller has the lock of the link. */
static void send_to_link(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output)
{
    struct unsent *unsent = send_or_queue(self, parts, count, size, output, NULL);
    if (unsent && unsent == self->unsent)
        note_link(self);
}

/* Send the lent message, and what was queued behind it, as far as there is room.  The caller has the lock of the link. */
static void send_queued(Link *self)
{
    struct unsent *unsent;
    while (!self->muted && (unsent = self->unsent)) {
        const struct iovec whole = {unsent->data, (size_t)unsent->size};
        if (!unsent->parts && !unsent->data)
            return; /* there was no memory for it: Python counts it */
        ssize_t sent = unsent->parts ? send_behind(self, unsent->parts, unsent->parts_count, unsent->sent)
                                     : send_behind(self, &whole, 1, unsent->sent);
        if (sent <= 0)
            return;
        unsent->sent += sent;
        if (unsent->sent < unsent->size)
            continue;
        self->sent_messages++;
        self->sent_bytes += unsent->size;
        forget_unsent(self);
    }
    self->clear = !self->unsent && !self->muted;
}

/* Copy the lent message, which is Python's from here on.  The caller has the lock of the link. */
static void own_lent(Link *self)
{
    struct unsent *unsent = self->lent;
    if ((unsent->data = malloc((size_t)unsent->size)))
        join_parts(unsent->data, unsent->parts, unsent->parts_count);
    unsent->parts = NULL;
    end_lending(self);
}

/* Send a large message.  Where the peer is about to take the rest, this waits for that, without the lock of the link, instead
 * of copying the message for Python. */
static void send_large_to_link(Link *self, const struct iovec *parts, int count, ssize_t size, struct output *output,
                               struct kept *kept)
{
    pthread_mutex_lock(&self->sending->mutex);
    const struct unsent *unsent = send_or_queue(self, parts, count, size, output, kept);
    int64_t until_ns = unsent ? clock_ns(CLOCK_MONOTONIC) + ROOM_NS : 0;
    while (unsent && self->lent == unsent) { /* else it is sent, or Python has taken it */
        int64_t left_ns = until_ns - clock_ns(CLOCK_MONOTONIC);
        struct pollfd room = {.fd = self->fd, .events = POLLOUT};
        pthread_mutex_unlock(&self->sending->mutex);
        int has_room = left_ns > 0 && poll(&room, 1, (int)(left_ns / 1000000) + 1) > 0 && room.revents == POLLOUT;
        pthread_mutex_lock(&self->sending->mutex);
        if (self->lent == unsent && has_room && !self->muted)
            send_queued(self);
        else if (self->lent == unsent)
            own_lent(self);
    }
    if (unsent && self->unsent)
        note_link(self);
    pthread_mutex_unlock(&self->sending->mutex);
}

#endif
