/* A large message from ROS to OpenIGTLink. */
#ifndef IGTL_GATEWAY_PASSAGE_LARGE_TO_IGTL_H
#define IGTL_GATEWAY_PASSAGE_LARGE_TO_IGTL_H

#include "_sending.h"
#include "_subscriptions.h"
#include "_unfilled.h"

/* A large message to OpenIGTLink: its outputs, with stamps in the header that are still to be set. */
struct large_outputs {
    struct output *outputs[MAX_OUTPUTS];
    struct iovec parts[MAX_OUTPUTS][MAX_PARTS];
    ssize_t sizes[MAX_OUTPUTS], bytes;
    int count, parts_count;
    uint8_t *made;
};

/* Make the outputs of a large message, whose pixels stay where they are if they need not be changed; 0: Python's.
 *
 * sent_ns: stamp of its sender; without one, or if it does not count, metadata with the stamp of the message cannot be
 * made before that is known. */
static int make_large(Stream *stream, const struct found *found, int64_t sent_ns, struct large_outputs *large)
{
    struct igtl_form forms[MAX_OUTPUTS] = {{0}};
    int apart = stream->bulk_from_ros.form == PICTURE;
    int64_t shown_ns = stream->own ? sent_ns : 0;
    ssize_t made = 0;
    large->count = stream->output_count, large->parts_count = apart ? MAX_PARTS : 1;
    large->bytes = 0;
    for (int i = 0; i < large->count; i++) {
        const struct output *output = large->outputs[i] = &stream->outputs[i];
        large->sizes[i] = output->size + found->size + output->tail_size;
        large->bytes += large->sizes[i];
        made += large->sizes[i] - (apart ? found->size : 0);
        if (!fits_digits(output->digits_at, found->header_ns, shown_ns) || large->bytes > LARGEST_MADE)
            return 0;
    }
    uint8_t *end = large->made = malloc((size_t)made + 1);
    for (int i = 0; end && i < large->count; i++) {
        const struct output *output = large->outputs[i];
        struct iovec *parts = large->parts[i];
        forms[i] = (struct igtl_form){output->template, output->tail, output->size, output->tail_size, output->digits_at, end};
        if (apart) {
            parts[0] = (struct iovec){end, (size_t)output->size};
            parts[1] = (struct iovec){(void *)(uintptr_t)found->data, (size_t)found->size};
            parts[2] = (struct iovec){end + output->size, (size_t)output->tail_size};
            end += output->size + output->tail_size;
        } else {
            parts[0] = (struct iovec){end, (size_t)large->sizes[i]};
            end += large->sizes[i];
        }
    }
    if (end && apart)
        frame_pixels(found, forms, large->count, shown_ns);
    return end && (apart || bulk_from_ros(&stream->bulk_from_ros, found, forms, large->count, shown_ns));
}

/* Whether a link of a stream has more to send than the passage may add to. */
static int is_behind(const Stream *stream)
{
    for (int i = 0; i < stream->output_count; i++)
        for (int k = 0; k < stream->outputs[i].link_count; k++)
            if (__atomic_load_n(&stream->outputs[i].links[k]->unsent_bytes, __ATOMIC_RELAXED) > MOST_UNSENT)
                return 1;
    return 0;
}

/* Give a large message, whose outputs are made, its number, its stamps and its places in the recorder's queue; 0: Python's.
 * The caller has the sequence lock. */
static int admit_to_igtl(Subscription *self, Stream *stream, const struct found *found, const struct large_outputs *large,
                         struct kept *kept, uint8_t **slots, struct kept **before)
{
    Passage *passage = self->passage;
    ssize_t size = (ssize_t)kept->message.length;
    int64_t stamp_ns = 0, now_ns = time_of_input(passage, &stamp_ns), source_ns = self->info.source_ns;
    int64_t sent_ns = found->header_ns ? found->header_ns : source_ns;
    int64_t shown_ns = stream->own && sent_ns > 0 ? sent_ns : stamp_ns;
    if (!now_ns || self->stream != stream || is_behind(stream) ||
        !begin_record(passage, stream, large->outputs, large->count, size + large->bytes, size + large->bytes))
        return 0;
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, NULL)) {
        end_record(passage);
        return 0;
    }
    uint64_t seq = take_numbers(passage, large->count, now_ns, stamp_ns);
    move_kept(kept, ADMITTED);
    reserve(passage, stream, large->outputs, large->sizes, large->count, seq, stamp_ns, source_ns, shown_ns, size, slots);
    for (int i = 0; i < large->count; i++) {
        put_u64((uint8_t *)large->parts[i][0].iov_base + TICKS_AT, ns_to_ticks(shown_ns));
        large->outputs[i]->sent++;
    }
    stream->received++;
    stream->converted++;
    *before = set_latest(stream, seq, stamp_ns, source_ns, kept);
    if (source_ns)
        count_time(passage, TO_IGTL, MIDDLEWARE, now_ns - passage->ahead_ns - source_ns);
    return 1;
}

/* Pass a large message on without the sequence lock, except for its number; 0, and nothing has happened: it must go to
 * Python.  The stream stays until the end: the caller has it in use. */
static int pass_large_to_igtl(Subscription *self, Stream *stream, struct kept *kept)
{
    Passage *passage = self->passage;
    int64_t begun_ns = clock_ns(CLOCK_MONOTONIC);
    struct found found = {0};
    struct large_outputs large = {.made = NULL};
    struct kept *before = NULL;
    struct unfilled *unfilled = calloc(1, sizeof *unfilled);
    uint8_t *slots[1 + MAX_OUTPUTS] = {NULL};
    int passes = unfilled && stream->is_bulk &&
                 find_in_ros(&stream->bulk_from_ros, kept->message.buffer, (ssize_t)kept->message.length, &found) &&
                 make_large(stream, &found, self->info.source_ns, &large);
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC), locked_ns = converted_ns;
    if (passes) {
        wait_for_sequence(passage);
        locked_ns = clock_ns(CLOCK_MONOTONIC);
        passes = admit_to_igtl(self, stream, &found, &large, kept, slots, &before);
        unlock_sequence(passage);
        leave_kept(before);
    }
    if (passes) {
        for (int i = 0; i < large.count; i++)
            for (int k = 0; k < large.outputs[i]->link_count; k++) {
                Link *link = large.outputs[i]->links[k];
                send_large_to_link(link, large.parts[i], large.parts_count, large.sizes[i], large.outputs[i], kept);
            }
        *unfilled = (struct unfilled){.direction = TO_IGTL, .passed_ns = clock_ns(CLOCK_MONOTONIC)};
        const struct iovec input = {kept->message.buffer, kept->message.length};
        add_entry(unfilled, slots[0], &input, 1);
        for (int i = 0; i < large.count; i++)
            add_entry(unfilled, slots[1 + i], large.parts[i], large.parts_count);
        count_times(passage, TO_IGTL, locked_ns - converted_ns, converted_ns - begun_ns, unfilled->passed_ns - locked_ns);
        fill_later(passage, unfilled, kept, large.made, large.bytes);
        return 1;
    }
    free(unfilled);
    free(large.made);
    return 0;
}

/* Pass on the held message, a large one, without the sequence lock, except for its number; 0: it is Python's. */
static int pass_held(Subscription *self)
{
    size_t size = self->message.length;
    wait_for_sequence(self->passage);
    Stream *stream = self->stream;
    if (stream)
        __atomic_store_n(&stream->is_in_use, 1, __ATOMIC_RELEASE);
    unlock_sequence(self->passage);
    struct kept *kept = stream && size > LARGEST_INPUT ? keep(&self->message) : NULL;
    int passed = kept && pass_large_to_igtl(self, stream, kept);
    if (stream)
        __atomic_store_n(&stream->is_in_use, 0, __ATOMIC_RELEASE);
    if (!passed) {
        give_back(kept);
        return 0;
    }
    leave_kept(kept);
    self->message.buffer = NULL;
    self->message.length = self->message.capacity = 0;
    self->last_size = size;
    move_holds(self, EMPTY);
    count_received(self);
    return 1;
}

#endif
