#include "uni4d_fg/landmark_plan.hpp"

#include <algorithm>
#include <numeric>

#include "uni4d_fg/parallel.hpp"

namespace uni4d_fg {

namespace {

/// More parts keep more threads busy, and take more memory and time to add up.
constexpr std::size_t kRecordsPerPart = 2000, kMostParts = 8;

/// One factor, as a number by which factors of a chunk are sorted: by frame, then landmark, then order of being given.
///     (frame * 64 + place of the landmark in its chunk) << 32 | number of the factor over all batches
using Entry = std::uint64_t;
constexpr int kNumberBits = 32;

struct Factor {
  const LandmarkBatch* batch;
  int index;  ///< of the batch within its family
  std::int64_t row;
};

/// Finds the batch of a factor by its number: reprojection batches first, then depth batches.
class FactorNumbers {
 public:
  explicit FactorNumbers(const LandmarkProblem& problem) : problem_(problem) {
    for (const auto* family : {&problem.reprojection, &problem.depth})
      for (const LandmarkBatch& batch : *family) begin_.push_back(begin_.back() + batch.count);
  }
  std::int64_t first_depth() const { return begin_[problem_.reprojection.size()]; }
  std::int64_t total() const { return begin_.back(); }
  std::int64_t begin(std::size_t batch) const { return begin_[batch]; }
  Factor find(std::int64_t number) const {
    std::size_t i = 0;
    while (number >= begin_[i + 1]) ++i;
    const std::size_t split = problem_.reprojection.size();
    const auto& family = i < split ? problem_.reprojection : problem_.depth;
    const std::size_t index = i < split ? i : i - split;
    return {&family[index], static_cast<int>(index), number - begin_[i]};
  }

 private:
  const LandmarkProblem& problem_;
  std::vector<std::int64_t> begin_{0};
};

template <typename F>
void for_each_batch(const LandmarkProblem& problem, F f) {
  for (const LandmarkBatch& batch : problem.reprojection) f(batch);
  for (const LandmarkBatch& batch : problem.depth) f(batch);
}

/// Rows of the landmarks: free ones first, then by first and last frame.
std::vector<int> order_landmarks(const LandmarkProblem& problem) {
  const auto count = static_cast<std::size_t>(problem.num_landmarks);
  std::vector<std::int64_t> first(count, problem.num_frames), last(count, -1);
  for_each_batch(problem, [&](const LandmarkBatch& batch) {
    for (std::int64_t n = 0; n < batch.count; ++n) {
      const auto row = static_cast<std::size_t>(batch.landmark[n]);
      first[row] = std::min(first[row], batch.pose[n]);
      last[row] = std::max(last[row], batch.pose[n]);
    }
  });
  std::vector<int> order(count);
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](int left, int right) {
    const auto a = static_cast<std::size_t>(left), b = static_cast<std::size_t>(right);
    if (problem.landmark_free[a] != problem.landmark_free[b])
      return problem.landmark_free[a] > problem.landmark_free[b];
    if (first[a] != first[b]) return first[a] < first[b];
    if (last[a] != last[b]) return last[a] < last[b];
    return left < right;
  });
  return order;
}

/// Sort the entries of a chunk, which come in the order of their numbers: by place, then by frame, each time stably.
void sort_entries(std::vector<Entry>::iterator begin, std::vector<Entry>::iterator end) {
  if (begin == end) return;
  const auto place = [](Entry entry) { return static_cast<std::size_t>(entry >> kNumberBits) % kChunkLandmarks; };
  const auto frame = [](Entry entry) { return static_cast<std::size_t>(entry >> kNumberBits) / kChunkLandmarks; };
  std::size_t lowest = frame(*begin), highest = lowest;
  for (auto entry = begin; entry != end; ++entry) {
    lowest = std::min(lowest, frame(*entry));
    highest = std::max(highest, frame(*entry));
  }
  std::vector<Entry> other(static_cast<std::size_t>(end - begin));
  const auto pass = [](auto from, auto to, auto out, std::size_t buckets, auto bucket) {
    std::vector<std::size_t> next(buckets + 1, 0);
    for (auto entry = from; entry != to; ++entry) next[bucket(*entry) + 1] += 1;
    std::partial_sum(next.begin(), next.end(), next.begin());
    for (auto entry = from; entry != to; ++entry)
      *(out + static_cast<std::ptrdiff_t>(next[bucket(*entry)]++)) = *entry;
  };
  pass(begin, end, other.begin(), kChunkLandmarks, place);
  pass(other.begin(), other.end(), begin, highest - lowest + 1, [&](Entry entry) { return frame(entry) - lowest; });
}

struct Record {
  int pair, layer, reprojection, depth;
  std::uint8_t landmark;
  const double* uv;
  double inverse_sigma_u, inverse_sigma_v, weight, depth_cue, inverse_sigma_depth, depth_weight;
};

void set_reprojection(const Factor& factor, Record& record) {
  const LandmarkBatch& batch = *factor.batch;
  const double* sigma = batch.sigma + factor.row * batch.sigma_columns;
  record.reprojection = factor.index;
  record.uv = batch.measured + 2 * factor.row;
  record.inverse_sigma_u = 1.0 / sigma[0];
  record.inverse_sigma_v = 1.0 / sigma[batch.sigma_columns - 1];
  record.weight = batch.weight[factor.row];
}

void set_depth(const Factor& factor, Record& record) {
  const LandmarkBatch& batch = *factor.batch;
  record.depth = factor.index;
  record.depth_cue = batch.measured[factor.row];
  record.inverse_sigma_depth = 1.0 / batch.sigma[factor.row];
  record.depth_weight = batch.weight[factor.row];
}

/// Cut the records of one frame into groups of eight and write them, one lane per record. All records of a group have
/// the same layer (see fill_chunk) and batches; lanes left over refer to the head's landmark with weight 0.
void append_groups(std::vector<Record>& records, int frame, LandmarkChunk& chunk) {
  auto same = [](const Record& a, const Record& b) {
    return a.layer == b.layer && a.reprojection == b.reprojection && a.depth == b.depth;
  };
  bool uniform = true;
  for (const Record& record : records) uniform = uniform && same(record, records.front());
  if (!uniform) {
    std::stable_sort(records.begin(), records.end(), [](const Record& a, const Record& b) {
      if (a.layer != b.layer) return a.layer < b.layer;
      if (a.reprojection != b.reprojection) return a.reprojection < b.reprojection;
      return a.depth < b.depth;
    });
  }
  std::size_t begin = 0;
  while (begin < records.size()) {
    std::size_t end = begin;
    while (end < records.size() && end < begin + kSimd8Width && same(records[begin], records[end])) ++end;
    const Record& head = records[begin];
    chunk.groups.push_back({frame, head.reprojection, head.depth, static_cast<int>(end - begin), head.layer == 0});
    const std::size_t at = chunk.data.size();
    chunk.data.resize(at + kFields * kSimd8Width, 0.0);
    double* data = chunk.data.data() + at;
    for (std::size_t lane = 0; lane < kSimd8Width; ++lane) {
      const bool used = begin + lane < end;
      const Record& record = used ? records[begin + lane] : head;
      chunk.lane_landmark.push_back(record.landmark);
      chunk.lane_pair.push_back(record.pair);
      if (!used) continue;
      if (record.uv != nullptr) {
        data[kU * kSimd8Width + lane] = record.uv[0];
        data[kV * kSimd8Width + lane] = record.uv[1];
        data[kInverseSigmaU * kSimd8Width + lane] = record.inverse_sigma_u;
        data[kInverseSigmaV * kSimd8Width + lane] = record.inverse_sigma_v;
        data[kWeight * kSimd8Width + lane] = record.weight;
      }
      if (record.inverse_sigma_depth > 0.0) {
        data[kLogDepth * kSimd8Width + lane] = std::log(record.depth_cue);
        data[kInverseSigmaDepth * kSimd8Width + lane] = record.inverse_sigma_depth;
        data[kDepthWeight * kSimd8Width + lane] = record.depth_weight;
      }
    }
    begin = end;
  }
  records.clear();
}

/// Turn a chunk's factors, sorted by frame and landmark, into pairs and groups.
///
/// The n-th reprojection and the n-th depth factor of a pair share a record, of layer n. Layer 0 writes a pair's
/// coupling block and later layers add to it; they are in groups of their own, after layer 0.
void fill_chunk(const FactorNumbers& numbers, std::vector<Entry>::const_iterator entry,
                std::vector<Entry>::const_iterator end, LandmarkChunk& chunk) {
  std::vector<Record> records;
  std::vector<int> seen_by(chunk.landmarks.size(), 0);
  int frame = -1;
  const auto factors = static_cast<std::size_t>(end - entry);
  chunk.pair_landmark.reserve(factors);
  chunk.data.reserve((factors / kSimd8Width + 1) * kFields * kSimd8Width);
  while (entry != end) {
    const Entry place = *entry >> kNumberBits;
    const auto landmark = static_cast<std::uint8_t>(place % kChunkLandmarks);
    if (static_cast<int>(place / kChunkLandmarks) != frame) {
      append_groups(records, frame, chunk);
      frame = static_cast<int>(place / kChunkLandmarks);
      chunk.frames.push_back(frame);
      chunk.seen.push_back(0);
      chunk.frame_begin.push_back(chunk.num_pairs());
    }
    const int pair = chunk.num_pairs();
    chunk.pair_landmark.push_back(landmark);
    chunk.seen.back() |= std::uint64_t{1} << landmark;
    seen_by[landmark] += 1;
    const std::size_t base = records.size();
    int reprojections = 0, depths = 0;
    for (; entry != end && *entry >> kNumberBits == place; ++entry) {
      const auto number = static_cast<std::int64_t>(*entry & ((Entry{1} << kNumberBits) - 1));
      const bool depth = number >= numbers.first_depth();
      const int layer = depth ? depths++ : reprojections++;
      const std::size_t at = base + static_cast<std::size_t>(layer);
      if (at == records.size()) records.push_back({pair, layer, 0, 0, landmark, nullptr, 0, 0, 0, 0, 0, 0});
      const Factor factor = numbers.find(number);
      if (depth)
        set_depth(factor, records[at]);
      else
        set_reprojection(factor, records[at]);
    }
  }
  append_groups(records, frame, chunk);
  chunk.frame_begin.push_back(chunk.num_pairs());
  chunk.cost = 8.0 * static_cast<double>(chunk.groups.size());
  if (!chunk.frozen)
    for (const int n : seen_by) chunk.cost += 0.5 * n * (n + 1) + 2.0 * n + 4.0;
}

/// Cut the chunks into ranges of about equal cost: (parts + 1) first chunks.
std::vector<int> cut_into_parts(const std::vector<LandmarkChunk>& chunks) {
  double total = 0.0;
  std::size_t groups = 0;
  for (const LandmarkChunk& chunk : chunks) {
    total += chunk.cost;
    groups += chunk.groups.size();
  }
  const std::size_t wanted = std::min({groups * kSimd8Width / kRecordsPerPart, kMostParts, chunks.size()});
  const std::size_t parts = std::max<std::size_t>(wanted, 1);
  const double share = total / static_cast<double>(parts);
  std::vector<int> begin{0};
  double sum = 0.0;
  for (std::size_t i = 0; i < chunks.size(); ++i) {
    while (begin.size() < parts && sum + 0.5 * chunks[i].cost >= share * static_cast<double>(begin.size()))
      begin.push_back(static_cast<int>(i));
    sum += chunks[i].cost;
  }
  while (begin.size() <= parts) begin.push_back(static_cast<int>(chunks.size()));
  return begin;
}

}  // namespace

LandmarkPlan plan_landmarks(const LandmarkProblem& problem, int threads) {
  const std::vector<int> order = order_landmarks(problem);
  LandmarkPlan plan;
  const auto count = static_cast<std::size_t>(problem.num_landmarks);
  std::vector<int> chunk_of(count), place(count);
  for (const int row : order) {
    const bool frozen = problem.landmark_free[static_cast<std::size_t>(row)] == 0;
    if (plan.chunks.empty() || plan.chunks.back().landmarks.size() == kChunkLandmarks ||
        plan.chunks.back().frozen != frozen) {
      plan.chunks.emplace_back();
      plan.chunks.back().frozen = frozen;
    }
    chunk_of[static_cast<std::size_t>(row)] = static_cast<int>(plan.chunks.size()) - 1;
    place[static_cast<std::size_t>(row)] = static_cast<int>(plan.chunks.back().landmarks.size());
    plan.chunks.back().landmarks.push_back(row);
  }

  // Count, then place every factor in its chunk's range.
  const FactorNumbers numbers(problem);
  std::vector<std::int64_t> begin(plan.chunks.size() + 1, 0);
  for_each_batch(problem, [&](const LandmarkBatch& batch) {
    for (std::int64_t n = 0; n < batch.count; ++n)
      begin[static_cast<std::size_t>(chunk_of[static_cast<std::size_t>(batch.landmark[n])]) + 1] += 1;
  });
  std::partial_sum(begin.begin(), begin.end(), begin.begin());
  std::vector<Entry> entries(static_cast<std::size_t>(numbers.total()));
  std::vector<std::int64_t> next(begin.begin(), begin.end() - 1);
  Entry number = 0;
  for_each_batch(problem, [&](const LandmarkBatch& batch) {
    for (std::int64_t n = 0; n < batch.count; ++n, ++number) {
      const auto row = static_cast<std::size_t>(batch.landmark[n]);
      const Entry where = static_cast<Entry>(batch.pose[n]) * kChunkLandmarks + static_cast<Entry>(place[row]);
      entries[static_cast<std::size_t>(next[static_cast<std::size_t>(chunk_of[row])]++)] =
          where << kNumberBits | number;
    }
  });
  parallel_for(static_cast<int>(plan.chunks.size()), threads, [&](int first, int last, int) {
    for (int i = first; i < last; ++i) {
      const auto from = entries.begin() + begin[static_cast<std::size_t>(i)];
      const auto to = entries.begin() + begin[static_cast<std::size_t>(i) + 1];
      sort_entries(from, to);
      fill_chunk(numbers, from, to, plan.chunks[static_cast<std::size_t>(i)]);
    }
  });
  for (LandmarkChunk& chunk : plan.chunks) {
    if (chunk.frozen) continue;
    chunk.first_pair = plan.num_pairs;
    plan.num_pairs += chunk.num_pairs();
  }
  plan.part_begin = cut_into_parts(plan.chunks);
  return plan;
}

}  // namespace uni4d_fg
