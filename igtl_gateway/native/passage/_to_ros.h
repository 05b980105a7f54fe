/* A small message from OpenIGTLink to ROS. */
#ifndef IGTL_GATEWAY_PASSAGE_TO_ROS_H
#define IGTL_GATEWAY_PASSAGE_TO_ROS_H

#include "_recording.h"

/* The outputs of a message, of which a row of the table may have none, and those without a subscriber are left out. */
struct chosen {
    struct output *outputs[MAX_OUTPUTS];
    struct ros_form forms[MAX_OUTPUTS]; /* of bulk */
    ssize_t sizes[MAX_OUTPUTS], bytes;  /* bytes: of all */
    int heard[MAX_OUTPUTS], count, wanted;
    unsigned waits; /* bits of outputs of which Python keeps the latest message for their first subscriber */
};

/* Choose the outputs of a message, each of at most ``most`` bytes; 0: it must go to Python. */
static int choose_outputs(Passage *self, Stream *stream, const uint8_t *data, ssize_t size, ssize_t most,
                          struct chosen *chosen)
{
    const struct igtl_bulk *bulk = &stream->bulk_from_igtl;
    chosen->count = chosen->wanted = 0, chosen->bytes = 0, chosen->waits = 0;
    for (int i = 0; i < stream->output_count; i++) {
        struct output *output = &stream->outputs[i];
        int count = chosen->count;
        struct ros_form *form = &chosen->forms[count];
        if (stream->is_bulk) {
            *form = output->form;
            if (!prepare_form(form, data + bulk->at, size - bulk->at - bulk->tail) || form->size > most)
                return 0;
        }
        chosen->sizes[count] = stream->is_bulk ? form->size : output->size; /* 0: the row does not apply */
        if (output->publisher->by_python) {
            if (!chosen->sizes[count])
                continue;
            stream->is_stale = 1; /* there might be another publisher now */
            return 0;
        }
        int hears = output->publisher->pointer && has_subscriber(self, output->publisher);
        if (output->publisher->latched && !hears && !self->builds_all) {
            if (!stream->keeps)
                return 0; /* Python keeps it for the first subscriber */
            chosen->waits |= 1u << i;
        }
        if (!hears && !self->builds_all)
            continue;
        chosen->wanted++;
        if (!chosen->sizes[count])
            continue;
        chosen->heard[count] = hears || output->publisher->latched;
        chosen->bytes += chosen->sizes[count];
        chosen->outputs[chosen->count++] = output;
    }
    return 1;
}

/* Publish an output, or count that it has no subscriber. */
static void publish_output(Passage *self, const struct chosen *chosen, int i, uint8_t *cdr)
{
    Publisher *publisher = chosen->outputs[i]->publisher;
    if (chosen->heard[i])
        publish(self, publisher, cdr, chosen->sizes[i]);
    else if (publisher->pointer)
        add(&publisher->unheard);
}

static void count_to_ros(Passage *self, Stream *stream, const struct chosen *chosen)
{
    for (int i = 0; i < chosen->count; i++)
        chosen->outputs[i]->sent++;
    stream->received++;
    if (chosen->count || self->builds_all)
        stream->converted++;
    else
        stream->unheard++;
}

/* Pass a whole message on; 0, and nothing has happened: it must go to Python.  The caller has the sequence lock. */
static int pass_to_ros(Passage *self, Stream *stream, const uint8_t *data, ssize_t size, int64_t begun_ns)
{
    int64_t stamp_ns, now_ns = time_of_input(self, &stamp_ns), locked_ns = clock_ns(CLOCK_MONOTONIC);
    double pose[7], place[3];
    int is_bulk = stream->is_bulk;
    if (!now_ns || (is_bulk ? size > LARGEST_RECEIVED || !bulk_from_igtl_fits(&stream->bulk_from_igtl, data, size)
                            : !pose_from_igtl(&stream->from_igtl, data, size, pose)))
        return 0;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t shown_ns = stream->own && source_ns > 0 ? source_ns : stamp_ns;
    struct chosen chosen;
    if (!choose_outputs(self, stream, data, size, LARGEST_OUTPUT, &chosen))
        return 0;
    int count = chosen.count;
    for (int i = 0; i < count; i++)
        chosen.forms[i].out = scratch_of(self, i);
    if (is_bulk && (!chosen.wanted || !bulk_from_igtl(&stream->bulk_from_igtl, data, size, chosen.forms, count, shown_ns)))
        return 0; /* without a subscriber, only the full path checks it */
    for (int i = 0; i < 3 && !is_bulk; i++)
        place[i] = get_f32(data + stream->place_at + 4 * i);
    struct kept *kept = stream->keeps ? keep_copy(data, size) : NULL;
    if ((stream->keeps && !kept) ||
        !begin_record(self, stream, chosen.outputs, count, size + chosen.bytes, LARGEST_RECORDED)) {
        leave_kept(kept);
        return 0;
    }
    if (!passes_guard(stream->guard, stamp_ns, shown_ns, is_bulk ? NULL : place)) {
        end_record(self);
        leave_kept(kept);
        return 0;
    }
    uint64_t seq = take_numbers(self, count, now_ns, stamp_ns);
    if (kept) {
        move_kept(kept, ADMITTED);
        move_kept(kept, FILLED); /* its bytes are recorded from where they were read */
        leave_kept(set_latest(stream, seq, stamp_ns, source_ns, kept));
        stream->waits = chosen.waits;
        leave_kept(kept);
    }
    int64_t converted_ns = clock_ns(CLOCK_MONOTONIC);
    for (int i = 0; i < count; i++) {
        struct output *output = chosen.outputs[i];
        uint8_t *cdr = scratch_of(self, i);
        if (!is_bulk) {
            memcpy(cdr, output->template, (size_t)output->size);
            put_ros_pose_or_id(cdr, output->size, output->at, output->id_at, shown_ns, pose, data);
        }
        publish_output(self, &chosen, i, cdr);
    }
    int64_t passed_ns = clock_ns(CLOCK_MONOTONIC);
    record(self, stream, chosen.outputs, chosen.sizes, count, seq, stamp_ns, source_ns, shown_ns, data, size);
    count_times(self, TO_ROS, locked_ns - begun_ns, converted_ns - locked_ns, passed_ns - converted_ns);
    count_recording(self, TO_ROS, passed_ns);
    count_to_ros(self, stream, &chosen);
    attend_recorder(self);
    return 1;
}

#endif
