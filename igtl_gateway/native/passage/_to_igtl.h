/* A small message from ROS to OpenIGTLink. */
#ifndef IGTL_GATEWAY_PASSAGE_TO_IGTL_H
#define IGTL_GATEWAY_PASSAGE_TO_IGTL_H

#include "_sending.h"

/* Build the messages of bulk; 0: it must go to Python. */
static int build_bulk(Passage *self, Stream *stream, const struct found *found, int64_t shown_ns, ssize_t *sizes)
{
    struct igtl_form forms[MAX_OUTPUTS] = {{0}};
    for (int i = 0; i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        sizes[i] = output->size + found->size + output->tail_size;
        if (sizes[i] > LARGEST_OUTPUT)
            return 0;
        forms[i] = (struct igtl_form){output->template, output->tail, output->size, output->tail_size, output->digits_at,
                                      scratch_of(self, i)};
    }
    return bulk_from_ros(&stream->bulk_from_ros, found, forms, stream->output_count, shown_ns);
}

/* Pass a whole message on; 0, and nothing has happened: it must go to Python.  The caller has the sequence lock.
 *
 * source_ns: stamp of the middleware (UTC), begun_ns: when this thread began with it (monotonic). */
static int pass_to_igtl(Passage *self, Stream *stream, const uint8_t *cdr, ssize_t size, int64_t source_ns,
                        int64_t begun_ns)
{
    int64_t stamp_ns, header_ns, now_ns = time_of_input(self, &stamp_ns), locked_ns = clock_ns(CLOCK_MONOTONIC);
    double numbers[12], place[3];
    struct found found = {0};
    int is_bulk = stream->is_bulk, count = stream->output_count;
    if (!now_ns || (is_bulk ? size > LARGEST_INPUT || !find_in_ros(&stream->bulk_from_ros, cdr, size, &found)
                            : !pose_from_ros(&stream->from_ros, cdr, size, &header_ns, numbers)))
        return 0;
    if (is_bulk)
        header_ns = found.header_ns;
    int64_t sent_ns = header_ns ? header_ns : source_ns;
    int64_t shown_ns = stream->own && sent_ns > 0 ? sent_ns : stamp_ns;
    struct output *built[MAX_OUTPUTS];
    ssize_t bytes = size, sizes[MAX_OUTPUTS];
    for (int i = 0; i < count; i++) {
        built[i] = &stream->outputs[i];
        sizes[i] = built[i]->size;
        if (!fits_digits(built[i]->digits_at, header_ns, shown_ns))
            return 0;
    }
    if (is_bulk && !build_bulk(self, stream, &found, shown_ns, sizes))
        return 0;
    for (int i = 0; i < count; i++)
        bytes += sizes[i];
    if (!is_bulk)
        memcpy(place, cdr + stream->place_at, sizeof place);
    if (!begin_record(self, stream, built, count, bytes, LARGEST_RECORDED))
        return 0;
    if (!lock_links(stream)) {
        end_record(self);
        return 0;
    }
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, is_bulk ? NULL : place)) {
        unlock_links(stream, count, 0);
        end_record(self);
        return 0;
    }
    uint64_t seq = take_numbers(self, count, now_ns, stamp_ns);
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC);
    for (int i = 0; i < count; i++) {
        struct output *output = built[i];
        uint8_t *message = scratch_of(self, i);
        if (!is_bulk) {
            memcpy(message, output->template, (size_t)output->size);
            put_u64(message + TICKS_AT, ns_to_ticks(shown_ns));
            put_igtl_pose(message, output->size, output->at, stream->from_ros.bytes, output->digits_at, numbers, header_ns,
                          shown_ns);
        }
        const struct iovec whole = {message, (size_t)sizes[i]};
        for (int k = 0; k < output->link_count; k++)
            send_to_link(output->links[k], &whole, 1, sizes[i], output);
        output->sent++;
    }
    unlock_links(stream, count, 0);
    int64_t passed_ns = clock_ns(CLOCK_MONOTONIC);
    record(self, stream, built, sizes, count, seq, stamp_ns, source_ns, shown_ns, cdr, size);
    if (source_ns)
        count_time(self, TO_IGTL, MIDDLEWARE, now_ns - self->ahead_ns - source_ns - (locked_ns - begun_ns));
    count_times(self, TO_IGTL, locked_ns - begun_ns, converted_ns - locked_ns, passed_ns - converted_ns);
    count_recording(self, TO_IGTL, passed_ns);
    stream->received++;
    stream->converted++;
    leave_kept(set_latest(stream, seq, stamp_ns, source_ns, NULL));
    stream->latest_size = size;
    memcpy(stream->latest, cdr, (size_t)size);
    attend_recorder(self);
    return 1;
}

#endif
