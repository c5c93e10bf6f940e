// A preloaded library that plays V4L2 capture devices, so that the real capture code runs, faults
// included, on a machine without video.
//
// FAKE_V4L2="PATH=CONTROL_FILE[;PATH=CONTROL_FILE...]" names the devices.  Each CONTROL_FILE holds
// a `struct control` (4096 bytes) that the test writes while the program under test runs.
//
// open, ioctl, mmap and close are interposed.  The descriptor of a device is an eventfd in semaphore
// mode, so poll works on it as it is; the buffers are a memfd.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#define MAX_DEVICES 8
#define MAX_BUFFERS 16
#define BILLION 1000000000ull

// The test mirrors this layout.
struct control {
  // The device.
  uint32_t pixel_format, width, height, millihertz;
  uint32_t padding;           // bytes after each line
  uint32_t buffer_flags;      // time-stamp flags of each buffer
  uint32_t standard;          // what the camera sends (0: a digital device)
  uint32_t field;
  uint32_t inputs;            // how many inputs it has
  uint32_t max_buffers;       // memory for so many
  // Faults that last.
  uint32_t unplugged, stalled, no_signal, busy;
  // Faults that happen so many times (or once with this value), then clear themselves.
  uint32_t damaged, dropped, short_bytes, eio, streamon_errno, next_sequence;
  int64_t stamp_shift_ns;     // added to every stamp
  // What happened.
  uint32_t produced, opened, closed, queued, last_errno;
};

enum state { FREE, QUEUED, DONE };

struct buffer {
  enum state state;
  uint32_t sequence, flags, used;
  int64_t stamp_ns;
};

struct device {
  char path[256];
  volatile struct control *control;
  int fd, memory, streaming;
  uint8_t *map;
  uint32_t count, size, sequence;
  uint32_t queue[MAX_BUFFERS], queued, done[MAX_BUFFERS], finished;
  struct buffer buffers[MAX_BUFFERS];
  pthread_t thread;
  pthread_mutex_t lock;
};

static struct device devices[MAX_DEVICES];
static int device_count;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static int (*real_open)(const char *, int, ...);
static int (*real_openat)(int, const char *, int, ...);
static int (*real_ioctl)(int, unsigned long, ...);
static int (*real_close)(int);
static void *(*real_mmap)(void *, size_t, int, int, int, off_t);

static void setup(void) {
  real_open = dlsym(RTLD_NEXT, "open");
  real_openat = dlsym(RTLD_NEXT, "openat");
  real_ioctl = dlsym(RTLD_NEXT, "ioctl");
  real_close = dlsym(RTLD_NEXT, "close");
  real_mmap = dlsym(RTLD_NEXT, "mmap");
  const char *environment = getenv("FAKE_V4L2");
  if (!environment) return;
  char *copy = strdup(environment), *rest;
  for (char *entry = strtok_r(copy, ";", &rest); entry && device_count < MAX_DEVICES;
       entry = strtok_r(NULL, ";", &rest)) {
    char *equals = strchr(entry, '=');
    if (!equals) continue;
    *equals = 0;
    int file = real_open(equals + 1, O_RDWR | O_CLOEXEC);
    if (file < 0) continue;
    struct device *device = &devices[device_count++];
    snprintf(device->path, sizeof device->path, "%s", entry);
    device->control = real_mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    real_close(file);
    device->fd = device->memory = -1;
    pthread_mutex_init(&device->lock, NULL);
  }
  free(copy);
}

static struct device *by_path(const char *path) {
  pthread_once(&once, setup);
  for (int i = 0; path && i < device_count; i++)
    if (!strcmp(devices[i].path, path)) return &devices[i];
  return NULL;
}

static struct device *by_fd(int fd) {
  pthread_once(&once, setup);
  for (int i = 0; fd >= 0 && i < device_count; i++)
    if (devices[i].fd == fd) return &devices[i];
  return NULL;
}

static int fail(struct device *device, int number) {
  device->control->last_errno = number;
  errno = number;
  return -1;
}

static uint32_t bytes_per_pixel(uint32_t format) { return format == V4L2_PIX_FMT_GREY ? 1 : 2; }

static uint32_t line_bytes(const struct device *device) {
  return device->control->width * bytes_per_pixel(device->control->pixel_format) +
         device->control->padding;
}

// Every pixel differs from its neighbours and from the frame before; padding is 0xa5.
static void paint(const struct device *device, uint8_t *bytes, uint32_t sequence) {
  uint32_t width = device->control->width, line = line_bytes(device);
  uint32_t step = bytes_per_pixel(device->control->pixel_format);
  for (uint32_t y = 0; y < device->control->height; y++, bytes += line) {
    if (step == 1)
      for (uint32_t x = 0; x < width; x++) bytes[x] = (uint8_t)(x * 7 + y * 13 + sequence * 101);
    else
      for (uint32_t x = 0; x < width; x++) {
        uint16_t value = (uint16_t)(x * 7 + y * 13 + sequence * 101);
        memcpy(bytes + 2 * x, &value, 2);
      }
    memset(bytes + width * step, 0xa5, line - width * step);
  }
}

static void signal_one(struct device *device) {
  uint64_t one = 1;
  if (write(device->fd, &one, sizeof one) < 0) perror("fake_v4l2");
}

static void produce(struct device *device, int64_t now_ns) {
  volatile struct control *control = device->control;
  if (control->next_sequence) {
    device->sequence = control->next_sequence;
    control->next_sequence = 0;
  }
  uint32_t sequence = device->sequence++;
  control->produced++;
  if (control->dropped) {
    control->dropped--;
    return;
  }
  if (!device->queued) return;
  uint32_t index = device->queue[0];
  memmove(device->queue, device->queue + 1, --device->queued * sizeof device->queue[0]);
  struct buffer *buffer = &device->buffers[index];
  paint(device, device->map + (size_t)index * device->size, sequence);
  buffer->sequence = sequence;
  buffer->stamp_ns = now_ns + control->stamp_shift_ns;
  buffer->flags = control->buffer_flags;
  buffer->used = line_bytes(device) * control->height;
  if (control->damaged) {
    control->damaged--;
    buffer->flags |= V4L2_BUF_FLAG_ERROR;
  }
  if (control->short_bytes) {
    buffer->used = control->short_bytes;
    control->short_bytes = 0;
  }
  buffer->state = DONE;
  device->done[device->finished++] = index;
  signal_one(device);
}

static void *run(void *argument) {
  struct device *device = argument;
  struct timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  uint64_t now_ns = (uint64_t)at.tv_sec * BILLION + (uint64_t)at.tv_nsec;
  while (device->streaming) {
    now_ns += 1000 * BILLION / device->control->millihertz;
    at = (struct timespec){(time_t)(now_ns / BILLION), (long)(now_ns % BILLION)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
    if (!device->streaming) break;
    if (device->control->unplugged) {
      signal_one(device);
      break;
    }
    if (device->control->stalled) continue;
    pthread_mutex_lock(&device->lock);
    produce(device, (int64_t)now_ns);
    pthread_mutex_unlock(&device->lock);
  }
  return NULL;
}

static void stream_off(struct device *device) {
  if (device->streaming) {
    device->streaming = 0;
    pthread_join(device->thread, NULL);
  }
  device->queued = device->finished = 0;
  for (int i = 0; i < MAX_BUFFERS; i++) device->buffers[i].state = FREE;
  uint64_t value;
  while (read(device->fd, &value, sizeof value) == sizeof value) {
  }
}

static void free_buffers(struct device *device) {
  if (device->map) munmap(device->map, (size_t)device->count * device->size);
  if (device->memory >= 0) real_close(device->memory);
  device->map = NULL;
  device->memory = -1;
  device->count = 0;
}

static int device_open(struct device *device) {
  if (device->control->unplugged) return fail(device, ENODEV);
  if (device->fd >= 0) return fail(device, EBUSY);
  device->fd = eventfd(0, EFD_SEMAPHORE | EFD_NONBLOCK | EFD_CLOEXEC);
  device->sequence = 0;
  device->control->opened++;
  return device->fd;
}

#define MODE_ARGUMENT                       \
  mode_t mode = 0;                          \
  if (flags & (O_CREAT | O_TMPFILE)) {      \
    va_list arguments;                      \
    va_start(arguments, flags);             \
    mode = va_arg(arguments, mode_t);       \
    va_end(arguments);                      \
  }                                         \
  struct device *device = by_path(path);    \
  if (device) return device_open(device)

int open(const char *path, int flags, ...) {
  MODE_ARGUMENT;
  return real_open(path, flags, mode);
}

int open64(const char *path, int flags, ...) {
  MODE_ARGUMENT;
  return real_open(path, flags | O_LARGEFILE, mode);
}

int openat(int folder, const char *path, int flags, ...) {
  MODE_ARGUMENT;
  return real_openat(folder, path, flags, mode);
}

int openat64(int folder, const char *path, int flags, ...) {
  MODE_ARGUMENT;
  return real_openat(folder, path, flags | O_LARGEFILE, mode);
}

int close(int fd) {
  struct device *device = by_fd(fd);
  if (device) {
    stream_off(device);
    free_buffers(device);
    device->fd = -1;
    device->control->closed++;
  }
  return real_close(fd);
}

static void *map(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
  struct device *device = by_fd(fd);
  return real_mmap(at, length, protection, flags, device ? device->memory : fd, offset);
}

void *mmap(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
  return map(at, length, protection, flags, fd, offset);
}

void *mmap64(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
  return map(at, length, protection, flags, fd, offset);
}

static void describe_format(const struct device *device, struct v4l2_pix_format *pix) {
  memset(pix, 0, sizeof *pix);
  pix->width = device->control->width;
  pix->height = device->control->height;
  pix->pixelformat = device->control->pixel_format;
  pix->field = device->control->field;
  pix->bytesperline = line_bytes(device);
  pix->sizeimage = pix->bytesperline * pix->height;
  pix->colorspace = V4L2_COLORSPACE_RAW;
}

static void describe_buffer(const struct device *device, uint32_t index, struct v4l2_buffer *out) {
  const struct buffer *buffer = &device->buffers[index];
  memset(out, 0, sizeof *out);
  out->index = index;
  out->type = V4L2_BUF_TYPE_VIDEO_CAPTURE;
  out->memory = V4L2_MEMORY_MMAP;
  out->length = device->size;
  out->m.offset = index * device->size;
  out->field = device->control->field;
  out->flags = V4L2_BUF_FLAG_MAPPED | buffer->flags |
               (buffer->state == QUEUED ? V4L2_BUF_FLAG_QUEUED : 0);
  out->bytesused = buffer->used;
  out->sequence = buffer->sequence;
  out->timestamp.tv_sec = buffer->stamp_ns / (int64_t)BILLION;
  out->timestamp.tv_usec = buffer->stamp_ns % (int64_t)BILLION / 1000;
}

static int request_buffers(struct device *device, struct v4l2_requestbuffers *request) {
  if (request->type != V4L2_BUF_TYPE_VIDEO_CAPTURE || request->memory != V4L2_MEMORY_MMAP)
    return fail(device, EINVAL);
  if (device->streaming) {
    if (request->count) return fail(device, EBUSY);
    stream_off(device);
  }
  free_buffers(device);
  memset(device->buffers, 0, sizeof device->buffers);
  uint32_t count = request->count;
  if (count > device->control->max_buffers) count = device->control->max_buffers;
  if (count > MAX_BUFFERS) count = MAX_BUFFERS;
  if (count) {
    device->count = count;
    device->size = (line_bytes(device) * device->control->height + 4095) & ~4095u;
    device->memory = memfd_create("fake_v4l2", MFD_CLOEXEC);
    size_t length = (size_t)count * device->size;
    if (ftruncate(device->memory, (off_t)length)) return fail(device, ENOMEM);
    device->map = real_mmap(NULL, length, PROT_READ | PROT_WRITE, MAP_SHARED, device->memory, 0);
  }
  request->count = count;
  request->capabilities = V4L2_BUF_CAP_SUPPORTS_MMAP;
  return 0;
}

static int queue_buffer(struct device *device, const struct v4l2_buffer *buffer) {
  if (buffer->index >= device->count || device->buffers[buffer->index].state != FREE)
    return fail(device, EINVAL);
  pthread_mutex_lock(&device->lock);
  device->buffers[buffer->index].state = QUEUED;
  device->queue[device->queued++] = buffer->index;
  device->control->queued = device->queued;
  pthread_mutex_unlock(&device->lock);
  return 0;
}

static int dequeue_buffer(struct device *device, struct v4l2_buffer *out) {
  uint64_t value;
  if (!device->streaming) return fail(device, EINVAL);
  if (device->control->eio) {
    device->control->eio--;
    return fail(device, EIO);
  }
  if (read(device->fd, &value, sizeof value) != sizeof value) return fail(device, EAGAIN);
  if (device->control->unplugged) return fail(device, ENODEV);
  pthread_mutex_lock(&device->lock);
  int finished = device->finished > 0;
  if (finished) {
    uint32_t index = device->done[0];
    memmove(device->done, device->done + 1, --device->finished * sizeof device->done[0]);
    device->buffers[index].state = FREE;
    describe_buffer(device, index, out);
  }
  pthread_mutex_unlock(&device->lock);
  return finished ? 0 : fail(device, EAGAIN);
}

static int device_ioctl(struct device *device, uint32_t request, void *argument) {
  volatile struct control *control = device->control;
  if (control->unplugged) return fail(device, ENODEV);
  switch (request) {
    case VIDIOC_QUERYCAP: {
      struct v4l2_capability *out = argument;
      memset(out, 0, sizeof *out);
      strcpy((char *)out->driver, "fake_v4l2");
      strcpy((char *)out->card, "fake grabber");
      snprintf((char *)out->bus_info, sizeof out->bus_info, "platform:fake-%03d",
               (int)(device - devices));
      out->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
      out->capabilities = out->device_caps | V4L2_CAP_DEVICE_CAPS;
      return 0;
    }
    case VIDIOC_ENUM_FMT: {
      struct v4l2_fmtdesc *out = argument;
      const uint32_t formats[] = {V4L2_PIX_FMT_MJPEG, control->pixel_format};
      if (out->index > 1) return fail(device, EINVAL);
      out->pixelformat = formats[out->index];
      return 0;
    }
    case VIDIOC_ENUM_FRAMESIZES: {
      struct v4l2_frmsizeenum *out = argument;
      if (out->index || out->pixel_format != control->pixel_format) return fail(device, EINVAL);
      out->type = V4L2_FRMSIZE_TYPE_DISCRETE;
      out->discrete.width = control->width;
      out->discrete.height = control->height;
      return 0;
    }
    case VIDIOC_S_FMT: {
      struct v4l2_format *format = argument;
      if (format->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return fail(device, EINVAL);
      if (control->busy) return fail(device, EBUSY);
      describe_format(device, &format->fmt.pix);
      return 0;
    }
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM: {
      struct v4l2_streamparm *parameters = argument;
      memset(&parameters->parm, 0, sizeof parameters->parm);
      parameters->parm.capture.capability = V4L2_CAP_TIMEPERFRAME;
      parameters->parm.capture.timeperframe.numerator = 1000;
      parameters->parm.capture.timeperframe.denominator = control->millihertz;
      return 0;
    }
    case VIDIOC_ENUMINPUT: {
      struct v4l2_input *out = argument;
      uint32_t index = out->index;
      if (index >= control->inputs) return fail(device, EINVAL);
      memset(out, 0, sizeof *out);
      out->index = index;
      snprintf((char *)out->name, sizeof out->name, "Composite%u", index);
      out->type = V4L2_INPUT_TYPE_CAMERA;
      out->status = control->no_signal ? V4L2_IN_ST_NO_SIGNAL : 0;
      return 0;
    }
    case VIDIOC_G_INPUT:
      *(int *)argument = 0;
      return 0;
    case VIDIOC_S_INPUT:
      return *(uint32_t *)argument < control->inputs ? 0 : fail(device, EINVAL);
    case VIDIOC_G_STD:
    case VIDIOC_S_STD:
      if (!control->standard) return fail(device, ENODATA);
      if (request == VIDIOC_G_STD) *(v4l2_std_id *)argument = V4L2_STD_NTSC | V4L2_STD_PAL;
      return 0;
    case VIDIOC_QUERYSTD:
      if (!control->standard) return fail(device, ENODATA);
      *(v4l2_std_id *)argument = control->standard;
      return 0;
    case VIDIOC_REQBUFS:
      return request_buffers(device, argument);
    case VIDIOC_QUERYBUF: {
      struct v4l2_buffer *buffer = argument;
      if (buffer->index >= device->count) return fail(device, EINVAL);
      describe_buffer(device, buffer->index, buffer);
      return 0;
    }
    case VIDIOC_QBUF:
      return queue_buffer(device, argument);
    case VIDIOC_DQBUF:
      return dequeue_buffer(device, argument);
    case VIDIOC_STREAMON:
      if (control->streamon_errno) {
        int number = (int)control->streamon_errno;
        control->streamon_errno = 0;
        return fail(device, number);
      }
      if (device->streaming) return 0;
      if (!device->count) return fail(device, EINVAL);
      device->streaming = 1;
      device->sequence = 0;
      pthread_create(&device->thread, NULL, run, device);
      pthread_setname_np(device->thread, "fake_v4l2");
      return 0;
    case VIDIOC_STREAMOFF:
      stream_off(device);
      return 0;
    default:
      return fail(device, ENOTTY);
  }
}

int ioctl(int fd, unsigned long request, ...) {
  va_list arguments;
  va_start(arguments, request);
  void *argument = va_arg(arguments, void *);
  va_end(arguments);
  struct device *device = by_fd(fd);
  if (!device) return real_ioctl(fd, request, argument);
  return device_ioctl(device, (uint32_t)request, argument);
}
