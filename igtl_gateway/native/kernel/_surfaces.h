/* Surfaces: meshes and markers of triangles, in both directions. */
#ifndef IGTL_GATEWAY_KERNEL_SURFACES_H
#define IGTL_GATEWAY_KERNEL_SURFACES_H

#include "_loops.h"

/* Set the numbers of points and triangles of POLYDATA; 0: not only these. */
static int count_surface(const uint8_t *content, ssize_t size, struct ros_form *form)
{
    if (size < POLYDATA_HEAD)
        return 0;
    uint64_t points = get_u32(content), cells = get_u32(content + 20);
    for (int word = 1; word < 10; word++) /* vertices, lines, strips, attributes */
        if (word != 5 && word != 6 && get_u32(content + 4 * word))
            return 0;
    form->count = (ssize_t)points, form->cells = (ssize_t)cells;
    return points && cells && cells <= MAX_PIECES && get_u32(content + 24) == CELL_BYTES * cells &&
           (uint64_t)size == POLYDATA_HEAD + 12 * points + CELL_BYTES * cells;
}

/* Return the offset of the vertices in a Mesh with this number of triangles. */
static ssize_t vertices_at(ssize_t cells) { return 12 + 12 * cells + (cells & 1 ? 4 : 0); }

/* Convert a block of a surface: its points, and the triangles that end in it. */
static uint32_t put_surface_block(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content,
                                  ssize_t begin, ssize_t end)
{
    const uint8_t *places = content + POLYDATA_HEAD;
    ssize_t cells_at = POLYDATA_HEAD + 12 * form->count;
    uint32_t odd = 0, points = (uint32_t)form->count;
    if (form->form == MESH && begin < cells_at) {
        ssize_t from = begin ? begin - POLYDATA_HEAD : 0, until = (end < cells_at ? end : cells_at) - POLYDATA_HEAD;
        uint8_t *out = form->out + vertices_at(form->cells);
        odd = floats_to_doubles(places + from, out + 2 * from, (until - from) / 4, stream->times, stream->by);
    }
    if (end > cells_at) {
        ssize_t first = begin > cells_at ? (begin - cells_at) / CELL_BYTES : 0;
        ssize_t count = (end - cells_at) / CELL_BYTES - first;
        const uint8_t *cells = content + cells_at + CELL_BYTES * first;
        if (form->form == MESH)
            odd |= cells_to_ros(cells, form->out + 8 + 12 * first, count, points);
        else
            odd |= corners_to_ros(cells, form->out + form->room - form->rest + 72 * first, count, places, points,
                                  stream->times, stream->by);
    }
    return odd;
}

/* Find triangles and points of a Mesh; 0: the message needs the full path. */
static int find_mesh(const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < 8)
        return 0;
    found->cells = get_u32_ros(cdr + 4);
    found->triangles = cdr + 8;
    if (!found->cells || found->cells > (size - 12) / 12)
        return 0;
    ssize_t at = vertices_at(found->cells);
    found->count = get_u32_ros(cdr + 8 + 12 * found->cells);
    found->data = cdr + at;
    if (!found->count || found->count > (size - at) / 24)
        return 0;
    found->size = POLYDATA_HEAD + 12 * found->count + CELL_BYTES * found->cells;
    return found->size <= UINT32_MAX;
}

/* Return the offset after a string or a sequence of elements of ``size`` bytes, aligned to 4; or -1 as its argument. */
static ssize_t after_sequence(const uint8_t *cdr, ssize_t size, ssize_t at, ssize_t element)
{
    at = (at + 3) & ~(ssize_t)3;
    if (at < 4 || at > size - 4)
        return -1;
    uint64_t bytes = (uint64_t)get_u32_ros(cdr + at) * (uint64_t)element;
    return bytes > (uint64_t)(size - at - 4) ? -1 : at + 4 + (ssize_t)bytes;
}

/* Find the points of a Marker of triangles without colours; 0: the message needs the full path. */
static int find_marker(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    ssize_t at = stream->data_at;
    found->count = get_u32_ros(cdr + at - stream->x);
    found->cells = found->count / 3;
    if (!found->count || found->count % 3 || found->count > (size - at) / 24)
        return 0;
    at += 24 * found->count;
    if (size - at < 4 || get_u32_ros(cdr + at))
        return 0;
    at = after_sequence(cdr, size, at + 4, 1); /* texture_resource */
    if (at < 0 || size - at < 12)
        return 0;
    at = after_sequence(cdr, size, ((at + 3) & ~(ssize_t)3) + 8, 1); /* texture: its frame after its stamp */
    at = after_sequence(cdr, size, at, 1);                           /* its format */
    at = after_sequence(cdr, size, at, 1);                           /* its data */
    at = after_sequence(cdr, size, at, 8);                           /* uv_coordinates */
    at = after_sequence(cdr, size, at, 1);                           /* text */
    found->size = POLYDATA_HEAD + 12 * found->count + CELL_BYTES * found->cells;
    return at >= 0;
}

/* ``put_next`` for surfaces; ``block``: at most so many bytes. */
static ssize_t put_next_of_surface(const struct ros_bulk *stream, const struct found *found, uint8_t *out, ssize_t done,
                                   ssize_t block)
{
    ssize_t cells_at = POLYDATA_HEAD + 12 * found->count;
    if (done == 0) {
        memset(out, 0, POLYDATA_HEAD);
        put_u32(out, (uint32_t)found->count);
        put_u32(out + 20, (uint32_t)found->cells);
        put_u32(out + 24, (uint32_t)(CELL_BYTES * found->cells));
        return POLYDATA_HEAD;
    }
    if (done < cells_at) {
        ssize_t first = (done - POLYDATA_HEAD) / 4, count = (block < cells_at - done ? block : cells_at - done) / 4;
        const uint8_t *from = found->data + 8 * first;
        uint32_t odd;
        if (stream->form == MESH) {
            odd = doubles_to_floats(from, out + done, count, stream->times, stream->by);
        } else {
            double pose[10]; /* position, orientation (none), scale */
            memcpy(pose, stream->sample + stream->height_at, sizeof pose);
            odd = moved_to_floats(from, out + done, count, pose + 7, pose, stream->times, stream->by);
        }
        return odd ? -1 : 4 * count;
    }
    ssize_t first = (done - cells_at) / CELL_BYTES, count = block / CELL_BYTES;
    if (stream->form == TRIANGLES)
        put_triangles(out + done, count, (uint32_t)(3 * first));
    else if (cells_to_igtl(found->triangles + 12 * first, out + done, count, (uint32_t)found->count))
        return -1;
    return CELL_BYTES * count;
}

#endif
