/* A large message from OpenIGTLink to ROS. */
#ifndef IGTL_GATEWAY_PASSAGE_LARGE_TO_ROS_H
#define IGTL_GATEWAY_PASSAGE_LARGE_TO_ROS_H

#include "_links.h"
#include "_to_ros.h"
#include "_unfilled.h"

/* Give a large message, whose outputs are made, its number, its stamps and its places in the recorder's queue; 0: Python's.
 * ``data``: at least its header.  The caller has the sequence lock. */
static int admit_to_ros(Link *self, Stream *stream, const uint8_t *data, const struct chosen *chosen, struct kept *kept,
                        uint8_t **slots, struct kept **before)
{
    Passage *passage = self->passage;
    ssize_t size = (ssize_t)kept->message.length;
    int64_t stamp_ns = 0, now_ns = time_of_input(passage, &stamp_ns), source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    if (!now_ns || !has_stream(self, stream))
        return 0;
    for (int i = 0; i < chosen->count; i++)
        if (chosen->outputs[i]->publisher->by_python)
            return 0;
    int64_t shown_ns = stream->own && source_ns > 0 ? source_ns : stamp_ns;
    if (!begin_record(passage, stream, chosen->outputs, chosen->count, size + chosen->bytes, size + chosen->bytes))
        return 0;
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, NULL)) {
        end_record(passage);
        return 0;
    }
    uint64_t seq = take_numbers(passage, chosen->count, now_ns, stamp_ns);
    for (int i = 0; i < chosen->count; i++)
        put_stamps(&chosen->forms[i], shown_ns); /* the last that changes of it: others may read it from here on */
    move_kept(kept, ADMITTED);
    reserve(passage, stream, chosen->outputs, chosen->sizes, chosen->count, seq, stamp_ns, source_ns, shown_ns, size, slots);
    count_to_ros(passage, stream, chosen);
    if (stream->keeps) {
        *before = set_latest(stream, seq, stamp_ns, source_ns, kept);
        stream->waits = chosen->waits;
    }
    return 1;
}

/* Pass a large message on without the sequence lock, except for its number; 0, and nothing has happened: it must go to
 * Python.  ``most``: bytes of its outputs.  The stream stays until the end: the caller owns a reference, or has it in use. */
static int pass_large_to_ros(Link *self, Stream *stream, struct kept *kept, int is_checked, ssize_t most)
{
    Passage *passage = self->passage;
    uint8_t *data = kept->message.buffer;
    ssize_t size = (ssize_t)kept->message.length;
    struct igtl_bulk bulk = stream->bulk_from_igtl;
    int64_t begun_ns = clock_ns(CLOCK_MONOTONIC);
    struct chosen chosen;
    struct kept *before = NULL;
    if (!stream->is_bulk || !bulk_from_igtl_fits(&stream->bulk_from_igtl, data, size) ||
        !choose_outputs(passage, stream, data, size, most, &chosen) || !chosen.wanted || chosen.bytes > most)
        return 0;
    bulk.check_crc &= !is_checked;
    /* The pixels of a picture stay where they are: what was before them is kept apart. */
    int stays = chosen.count == 1 && chosen.forms->form == PICTURE && chosen.forms->room <= bulk.at && !bulk.check_crc;
    uint8_t *made = malloc(stays ? (size_t)bulk.at : (size_t)chosen.bytes + 1), *end = made, *slots[1 + MAX_OUTPUTS] = {NULL};
    for (int i = 0; made && i < chosen.count; end += chosen.sizes[i++])
        chosen.forms[i].out = stays ? data + bulk.at - chosen.forms->room : end;
    if (made && stays) {
        move_kept(kept, STAYS);
        memcpy(made, data, (size_t)bulk.at);
        put_frame(chosen.forms, size - bulk.at - bulk.tail, 0);
    }
    struct unfilled *unfilled = calloc(1, sizeof *unfilled);
    int passes = made && unfilled && (stays || bulk_from_igtl(&bulk, data, size, chosen.forms, chosen.count, 0));
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC), locked_ns = converted_ns;
    if (passes) {
        wait_for_sequence(passage);
        locked_ns = clock_ns(CLOCK_MONOTONIC);
        passes = admit_to_ros(self, stream, stays ? made : data, &chosen, kept, slots, &before);
        unlock_sequence(passage);
        leave_kept(before);
    }
    if (passes) {
        for (int i = 0; i < chosen.count; i++)
            publish_output(passage, &chosen, i, chosen.forms[i].out);
        *unfilled = (struct unfilled){.direction = TO_ROS, .passed_ns = clock_ns(CLOCK_MONOTONIC)};
        const struct iovec input[2] = {{stays ? made : data, (size_t)bulk.at}, {data + bulk.at, (size_t)(size - bulk.at)}};
        add_entry(unfilled, slots[0], input, 2);
        for (int i = 0; i < chosen.count; i++) {
            const struct iovec output = {chosen.forms[i].out, (size_t)chosen.sizes[i]};
            add_entry(unfilled, slots[1 + i], &output, 1);
        }
        count_times(passage, TO_ROS, locked_ns - converted_ns, converted_ns - begun_ns, unfilled->passed_ns - locked_ns);
        fill_later(passage, unfilled, kept, made, chosen.bytes);
        return 1;
    }
    if (made && stays) {
        memcpy(data, made, (size_t)bulk.at);
        move_kept(kept, OWN);
    }
    free(unfilled);
    free(made);
    return 0;
}

#endif
