/* Recorded entries against what compiled streams make of the recorded inputs.
 *
 * No lock is needed: the passage of a verification has no threads, and its links and subscriptions are none of a system. */
#ifndef IGTL_GATEWAY_PASSAGE_RECHECK_H
#define IGTL_GATEWAY_PASSAGE_RECHECK_H

#include "_links.h"
#include "_subscriptions.h"

/* Why a run of entries ends; replay/recheck.py has the same numbers. */
enum { AT_END, NOT_COMPILED, CHOSEN, MISFIT, OTHER_OUTPUT, GUARDED, NO_ROOM };

/* Columns of consecutive entries; places are those of the messages in ``data``. */
struct recorded {
    const uint8_t *data;
    ssize_t size, count;
    const int32_t *idents; /* of the stream of each entry; -1: none that is compared here */
    const int64_t *numbers, *times, *sources, *begins, *ends;
    const uint8_t *chosen; /* inputs that the full path computes */
    Link *const *links;    /* by ident of an input; one of both, or none */
    Subscription *const *subscriptions;
    ssize_t streams;
};

/* What was computed, and where the run has ended. */
struct rechecked {
    ssize_t row, inputs, last_input;
    int why;
};

/* Memory for the outputs of a message. */
struct room {
    uint8_t *bytes;
    ssize_t size;
};

static int room_for(struct room *room, ssize_t size)
{
    if (size <= room->size)
        return 1;
    uint8_t *bytes = realloc(room->bytes, (size_t)size);
    if (!bytes)
        return 0;
    room->bytes = bytes, room->size = size;
    return 1;
}

static int is_inside(const struct recorded *all, ssize_t row)
{
    return 0 <= all->begins[row] && all->begins[row] <= all->ends[row] && all->ends[row] <= all->size;
}

#define LATEST_NS ((uint64_t)1 << 62) /* the year 2116 */

/* Whether a number is ``step`` more than another one; both may be any. */
static int is_after(int64_t number, int64_t other, int64_t step)
{
    return (uint64_t)number == (uint64_t)other + (uint64_t)step;
}

/* Whether an entry is the ``step``-th output of an input, with these bytes. */
static int is_output(const struct recorded *all, ssize_t input, ssize_t step, uint64_t ident, int64_t shown_ns,
                     const uint8_t *bytes, ssize_t size)
{
    ssize_t row = input + step;
    return row < all->count && all->idents[row] >= 0 && (uint64_t)all->idents[row] == ident &&
           is_after(all->numbers[row], all->numbers[input], step) && is_after(all->times[row], all->times[input], step) &&
           shown_ns > 0 && all->sources[row] == shown_ns && is_inside(all, row) &&
           all->ends[row] - all->begins[row] == size && !memcmp(all->data + all->begins[row], bytes, (size_t)size);
}

/* Have memory for the latest message of a stream: before the guard sees the message, which the full path computes without. */
static int room_for_latest(Stream *stream, ssize_t size)
{
    if (size <= LARGEST_INPUT)
        return 1;
    uint8_t *latest = realloc(stream->latest, (size_t)size);
    if (!latest)
        return 0;
    stream->latest = latest;
    return 1;
}

/* Keep the latest message of a stream, as the passage does. */
static void keep_latest(const struct recorded *all, ssize_t row, Stream *stream, const uint8_t *message, ssize_t size)
{
    leave_kept(set_latest(stream, (uint64_t)all->numbers[row], all->times[row], all->sources[row], NULL));
    stream->latest_size = size;
    memcpy(stream->latest, message, (size_t)size);
}

/* Compare the outputs of a message to ROS.  Returns why it is left to the full path, else AT_END and their number. */
static int recheck_to_ros(const struct recorded *all, ssize_t row, Stream *stream, struct room *room, ssize_t *outputs)
{
    const uint8_t *data = all->data + all->begins[row];
    ssize_t size = all->ends[row] - all->begins[row], needed = 0;
    struct ros_form forms[MAX_OUTPUTS];
    double pose[7], place[3];
    int is_bulk = stream->is_bulk;
    if (is_bulk ? !bulk_from_igtl_fits(&stream->bulk_from_igtl, data, size)
                : !pose_from_igtl(&stream->from_igtl, data, size, pose))
        return MISFIT;
    const int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    const int64_t shown_ns = stream->own && source_ns > 0 ? source_ns : all->times[row];
    if (source_ns != all->sources[row])
        return OTHER_OUTPUT;
    const struct igtl_bulk *bulk = &stream->bulk_from_igtl;
    for (int i = 0; i < stream->output_count; i++) {
        forms[i] = stream->outputs[i].form;
        if (is_bulk && !prepare_form(&forms[i], data + bulk->at, size - bulk->at - bulk->tail))
            return MISFIT;
        needed += is_bulk ? forms[i].size : stream->outputs[i].size;
    }
    if (!room_for(room, needed))
        return NO_ROOM;
    uint8_t *out = room->bytes;
    for (int i = 0; is_bulk && i < stream->output_count; i++)
        forms[i].out = out, out += forms[i].size;
    if (is_bulk && !bulk_from_igtl(bulk, data, size, forms, stream->output_count, shown_ns))
        return MISFIT;
    for (int i = 0; i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        const uint8_t *made = is_bulk ? forms[i].out : room->bytes;
        const ssize_t length = is_bulk ? forms[i].size : output->size;
        if (!length)
            continue;
        if (!is_bulk) {
            memcpy(room->bytes, output->template, (size_t)length);
            put_ros_pose_or_id(room->bytes, length, output->at, output->id_at, shown_ns, pose, data);
        }
        if (!is_output(all, row, ++*outputs, output->number, shown_ns, made, length))
            return OTHER_OUTPUT;
    }
    for (int i = 0; i < 3 && !is_bulk; i++)
        place[i] = get_f32(data + stream->place_at + 4 * i);
    if (stream->keeps && !room_for_latest(stream, size))
        return NO_ROOM;
    if (!passes_guard(stream->guard, all->times[row], shown_ns, is_bulk ? NULL : place))
        return GUARDED;
    if (stream->keeps)
        keep_latest(all, row, stream, data, size);
    for (int i = 0; i < stream->output_count; i++)
        stream->outputs[i].sent += !is_bulk || forms[i].size;
    return AT_END;
}

/* The same for a message to OpenIGTLink. */
static int recheck_to_igtl(const struct recorded *all, ssize_t row, Stream *stream, struct room *room, ssize_t *outputs)
{
    const uint8_t *cdr = all->data + all->begins[row];
    ssize_t size = all->ends[row] - all->begins[row], needed = 0;
    struct igtl_form forms[MAX_OUTPUTS] = {{0}};
    ssize_t sizes[MAX_OUTPUTS];
    struct found found = {0};
    double numbers[12], place[3];
    int is_bulk = stream->is_bulk;
    int64_t header_ns = 0;
    if (is_bulk ? !find_in_ros(&stream->bulk_from_ros, cdr, size, &found)
                : !pose_from_ros(&stream->from_ros, cdr, size, &header_ns, numbers))
        return MISFIT;
    if (is_bulk)
        header_ns = found.header_ns;
    const int64_t sent_ns = header_ns ? header_ns : all->sources[row];
    const int64_t shown_ns = stream->own && sent_ns > 0 ? sent_ns : all->times[row];
    for (int i = 0; i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        if (!fits_digits(output->digits_at, header_ns, shown_ns))
            return MISFIT;
        sizes[i] = output->size + (is_bulk ? found.size + output->tail_size : 0);
        needed += sizes[i];
    }
    if (!room_for(room, needed))
        return NO_ROOM;
    uint8_t *out = room->bytes;
    for (int i = 0; is_bulk && i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        forms[i] = (struct igtl_form){output->template, output->tail, output->size, output->tail_size,
                                      output->digits_at, out};
        out += sizes[i];
    }
    if (is_bulk && !bulk_from_ros(&stream->bulk_from_ros, &found, forms, stream->output_count, shown_ns))
        return MISFIT;
    for (int i = 0; i < stream->output_count; i++) {
        const struct output *output = &stream->outputs[i];
        uint8_t *made = is_bulk ? forms[i].out : room->bytes;
        if (!is_bulk) {
            memcpy(made, output->template, (size_t)output->size);
            put_u64(made + TICKS_AT, ns_to_ticks(shown_ns));
            put_igtl_pose(made, output->size, output->at, stream->from_ros.bytes, output->digits_at, numbers, header_ns,
                          shown_ns);
        }
        if (!is_output(all, row, ++*outputs, output->number, shown_ns, made, sizes[i]))
            return OTHER_OUTPUT;
    }
    if (!is_bulk)
        memcpy(place, cdr + stream->place_at, sizeof place);
    if (!room_for_latest(stream, size))
        return NO_ROOM;
    if (!passes_guard(stream->guard, all->times[row], shown_ns, is_bulk ? NULL : place))
        return GUARDED;
    keep_latest(all, row, stream, cdr, size);
    for (int i = 0; i < stream->output_count; i++)
        stream->outputs[i].sent++;
    return AT_END;
}

/* The compiled stream of an input; NULL: there is none. */
static Stream *compiled_stream(const struct recorded *all, ssize_t row)
{
    const int32_t ident = all->idents[row];
    Stream *stream = NULL;
    if (ident < 0 || ident >= all->streams || !is_inside(all, row))
        return NULL;
    if ((uint64_t)all->times[row] > LATEST_NS || (uint64_t)all->sources[row] > LATEST_NS)
        return NULL; /* the guard adds to them */
    const ssize_t size = all->ends[row] - all->begins[row];
    if (all->links[ident])
        stream = size < HEADER_SIZE ? NULL : stream_of(all->links[ident], all->data + all->begins[row], size);
    else if (all->subscriptions[ident])
        stream = all->subscriptions[ident]->stream;
    return stream && stream->number == (uint64_t)ident ? stream : NULL;
}

/* Compare the outputs of inputs from a row on, up to the first that is left to the full path.
 *
 * last_number: number of the entry before the row, which the first input must follow. */
static struct rechecked recheck(const struct recorded *all, ssize_t row, int64_t last_number)
{
    struct rechecked done = {.row = row, .last_input = -1};
    struct room room = {0};
    for (; done.row < all->count; done.inputs++) {
        if (!is_after(all->numbers[done.row], last_number, 1)) {
            done.why = NOT_COMPILED;
            break;
        }
        if (all->chosen[done.row]) {
            done.why = CHOSEN;
            break;
        }
        Stream *stream = compiled_stream(all, done.row);
        ssize_t outputs = 0;
        done.why = !stream        ? NOT_COMPILED
                   : stream->link ? recheck_to_ros(all, done.row, stream, &room, &outputs)
                                  : recheck_to_igtl(all, done.row, stream, &room, &outputs);
        if (done.why)
            break;
        stream->received++, stream->converted++;
        done.last_input = done.row;
        done.row += 1 + outputs;
        last_number = all->numbers[done.row - 1];
    }
    free(room.bytes);
    return done;
}

#endif
